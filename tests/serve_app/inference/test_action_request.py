"""Parsing of action requests before the policy is known, tokens of recurrent state, and limits of sizes."""

import base64
import json
import re
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from league.errors import BodyTooLarge, InvalidInput, InvalidReference, InvalidState, LeagueError
from league.refs import MAX_VERSION
from league.spaces import Box, Leaf
from serve_app.codecs.request_limits import LARGE_BODY, OVERHEAD_SIZE, RequestLimits
from serve_app.codecs.state_tokens import common_version, read_state, read_token, write_tokens
from serve_app.inference.action_request import KEYS, parse_action_request, pinned_version, reject_unknown_keys
from serve_app.live_versions.policies import ActionOptions
from tests.support.examples import examples

MODEL, SHA256 = "memory.shared", "ab" * 32


LEAVES: list[tuple[str, Leaf]] = [
    ("state_in_0", Box(dtype="float32", shape=(2, 3), low=None, high=None)),
    ("state_in_1", Box(dtype="int16", shape=(), low=None, high=None)),
]


def some_state(rows: int = 1) -> dict[str, NDArray]:
    numbers = np.arange(6 * rows, dtype=np.float32).reshape(rows, 2, 3)
    return {"state_in_0": numbers, "state_in_1": np.arange(rows, dtype=np.int16)}


def token(version: int = 7, state: dict[str, NDArray] | None = None, model: str = MODEL, sha256: str = SHA256) -> str:
    return write_tokens(model, version, sha256, some_state() if state is None else state)[0]


def token_of(version: int, model: str = "memory.shared") -> str:
    return token(version, {"state_in_0": np.zeros((1, 1), np.float32)}, model)


def test_one_observation_is_a_batch_of_one() -> None:
    request = parse_action_request({"observation": [1, 2]}, max_batch=8)
    assert (request.observations, request.is_batch, request.strings) == ([[1, 2]], False, 1)
    assert (request.options, request.tokens) == (ActionOptions(), None)


def test_all_options_are_parsed() -> None:
    document = {
        "observations": [1, 2],
        "explore": True,
        "seed": [3, 4],
        "probabilities": True,
        "state": [token_of(7), None],
    }
    ask = parse_action_request(document, max_batch=8)
    assert (ask.is_batch, ask.options) == (True, ActionOptions(explore=True, seed=[3, 4], values="distribution"))
    assert ask.tokens is not None
    assert [text and text.version for text in ask.tokens] == [7, None]
    assert ask.strings == 6, "five keys, one token"


INVALID: tuple[tuple[dict[str, Any], type[LeagueError], str], ...] = (
    ({}, InvalidInput, "neither observation nor observations"),
    ({"observation": 1, "observations": [1]}, InvalidInput, "both observation and observations"),
    ({"observations": 1}, InvalidInput, "observations is a number"),
    ({"observations": {"observation": 1}}, InvalidInput, "observations is an object"),
    ({"observations": []}, InvalidInput, "empty"),
    ({"observations": [1] * 9}, BodyTooLarge, "has 9 items, expected at most 8"),
    ({"observation": 1, "explore": None}, InvalidInput, "explore is null, expected true or false"),
    ({"observation": 1, "explore": "yes"}, InvalidInput, "explore is a string"),
    ({"observation": 1, "probabilities": 1}, InvalidInput, "probabilities is a number"),
    ({"observation": 1, "probabilities": "yes"}, InvalidInput, "probabilities is a string"),
    *(({"observation": 1, "seed": seed}, InvalidInput, "seed must be") for seed in (True, 0.5, -1, 2**63, 2**64, [1])),
    ({"observations": [1, 2], "seed": [1]}, InvalidInput, "seed has 1 integers, expected 2"),
    ({"observations": [1, 2], "seed": [1, "2"]}, InvalidInput, "seed must be"),
    ({"observation": 1, "state": 3}, InvalidState, "one string per observation"),
    ({"observation": 1, "state": {"state_in_0": [[1.0]]}}, InvalidState, "one string per observation"),
    ({"observation": 1, "state": [token_of(7)]}, InvalidState, "one string per observation"),
    ({"observations": [1], "state": token_of(7)}, InvalidState, "state is a string, expected a list"),
    ({"observations": [1, 2], "state": [token_of(7)]}, InvalidState, "state has 1 items, expected 2"),
    ({"observations": [1, 2], "state": [token_of(7), "x"]}, InvalidState, "not a complete token"),
    ({"observations": [1, 2], "state": [token_of(7), {}]}, InvalidState, "one string per observation"),
)


def test_invalid_requests_are_rejected(subtests: pytest.Subtests) -> None:
    for document, error, message in INVALID:
        with subtests.test(document=document), pytest.raises(error, match=message):
            parse_action_request(document, max_batch=8)


def test_an_unknown_key_is_rejected() -> None:
    reject_unknown_keys({"observation": 1, "state": None}, KEYS)
    with pytest.raises(InvalidInput, match="unknown key 'proabilities', expected analysis, deadline_ms, explore"):
        reject_unknown_keys({"observation": 1, "proabilities": True}, KEYS)


def pinned(state: Any, version: str, model: str = "memory") -> str:
    request = parse_action_request({"observations": [1] * len(state), "state": state}, max_batch=8)
    return pinned_version(request, model, version)


def test_a_token_selects_the_version() -> None:
    assert pinned([None], "champion") == "champion"
    assert pinned([token_of(7)], "champion") == "7"
    assert pinned([token_of(7)], "7") == "7"
    assert pinned([None, token_of(7), None, token_of(7)], "candidate", "memory.shared") == "7"
    assert pinned_version(parse_action_request({"observation": 1}, max_batch=8), "memory", "champion") == "champion"


def test_a_contradiction_to_a_token_is_rejected() -> None:
    for state, version, model, error, message in (
        ([token_of(7)], "8", "memory", InvalidState, "of version 7, but the request is for version 8"),
        ([token_of(7), token_of(8)], "champion", "memory", InvalidState, r"several versions \(7, 8\)"),
        ([token_of(7)], "Champion", "memory", InvalidReference, "must consist of"),
        ([token_of(7)], "champion", "other", InvalidState, "is of memory.shared, expected other"),
        ([None, token_of(7)], "7", "mem", InvalidState, "expected mem"),
    ):
        with pytest.raises(error, match=message):
            pinned(state, version, model)


finite = st.floats(width=32, allow_nan=False, allow_infinity=False)


def states(rows: int) -> st.SearchStrategy[dict[str, NDArray]]:
    numbers = arrays(np.float32, (rows, 2, 3), elements=finite)
    return st.fixed_dictionaries({"state_in_0": numbers, "state_in_1": arrays(np.int16, (rows,))})


@given(data=st.data(), rows=st.integers(1, 4), version=st.integers(1, MAX_VERSION))
def test_a_state_survives_encoding(data: st.DataObject, rows: int, version: int) -> None:
    state = data.draw(states(rows))
    texts = write_tokens(MODEL, version, SHA256, state)
    tokens = [read_token(text) for text in texts]
    assert len(texts) == rows
    assert all(re.fullmatch(r"[A-Za-z0-9_-]+", text) for text in texts)
    assert {(token.model, token.version) for token in tokens} == {(MODEL, version)}
    assert common_version(tokens) == version
    read = read_state(tokens, MODEL, SHA256, LEAVES)
    for name, array in state.items():
        assert (read[name].dtype, read[name].shape) == (array.dtype, array.shape)
        assert read[name].tobytes() == array.tobytes()
        assert read[name].flags.aligned


def test_missing_tokens_are_zero_states() -> None:
    tokens = [None, *(read_token(text) for text in write_tokens(MODEL, 7, SHA256, some_state(2))), None]
    read = read_state(tokens, MODEL, SHA256, LEAVES)
    assert read["state_in_0"][1:3].tolist() == some_state(2)["state_in_0"].tolist()
    assert not read["state_in_0"][[0, 3]].any()
    assert read["state_in_1"].tolist() == [0, 0, 1, 0]


def test_a_token_is_little_longer_than_its_state() -> None:
    state = {"state_in_0": np.zeros((1, 256), np.float32)}
    assert len(token(state=state)) < 4 / 3 * 1024 + 80


def test_an_invalid_token_is_rejected() -> None:
    for text in ("", "a", "abcd", "****", "Ä" * 40, "a" * 200, "=" * 40, "\0", "\n" * 4, "🎲" * 9):
        with pytest.raises(InvalidState, match="not a complete token of an earlier response"):
            read_token(text)
    for value in (3, 1.5, True, [], ["a"], {}, b"a", [[1.0]]):
        with pytest.raises(InvalidState, match="one string per observation"):
            read_token(value)


@examples(300)
@given(at=st.integers(0, 500), put=st.text(max_size=3), cut=st.integers(0, 3))
def test_a_damaged_token_is_rejected(at: int, put: str, cut: int) -> None:
    valid = token()
    at %= len(valid)
    damaged = valid[:at] + put + valid[at + cut :]
    try:
        read = read_token(damaged)
    except InvalidState:
        return
    # The last digit of base64 may have unused bits.
    assert damaged[: len(valid) - 1] == valid[:-1]
    assert read == read_token(valid)


@examples(300)
@given(text=st.text(alphabet="ABCXYZabcxyz0189-_", max_size=120) | st.text(max_size=60))
def test_any_text_is_rejected_cleanly(text: str) -> None:
    with pytest.raises(InvalidState):
        read_token(text)


def test_a_token_of_another_policy_is_rejected() -> None:
    for other, message in (
        (token(model="memory.other"), "is of memory.other, expected memory.shared"),
        (token(model="memories.shared"), "is of memories.shared"),
        (token(sha256="cd" * 32), "a different version 7 of memory.shared than the one in this registry"),
        (token(state={"state_in_0": np.zeros((1, 2, 3), np.float32)}), "has 24 bytes, expected 26"),
        (token(state={"state_in_0": np.zeros((1, 7), np.float32)}), "has 28 bytes, expected 26"),
        (token(state=some_state() | {"state_in_0": np.full((1, 2, 3), np.nan, np.float32)}), "NaN"),
        (token(state=some_state() | {"state_in_0": np.full((1, 2, 3), np.inf, np.float32)}), "infinity"),
    ):
        with pytest.raises(InvalidState, match=message):
            read_state([read_token(other)], MODEL, SHA256, LEAVES)


MAX_BATCH = 64
SHAPES = st.lists(st.lists(st.integers(1, 6), max_size=4).map(tuple), min_size=1, max_size=3)
NUMBERS = st.sampled_from([0.0, 1.0, -1.7976931348623157e308, 5e-324])
INDENTS = st.sampled_from([None, 1])


def limits_of(shapes: list[tuple[int, ...]]) -> RequestLimits:
    return RequestLimits.of([Box(dtype="float64", shape=shape, low=None, high=None) for shape in shapes])


@st.composite
def requests(draw: st.DrawFn) -> tuple[RequestLimits, int, bytes]:
    """The limits of a space, and a valid request: its number of observations and its body."""
    shapes, rows, indent = draw(SHAPES), draw(st.integers(1, MAX_BATCH)), draw(INDENTS)
    number, encode = draw(NUMBERS), draw(st.sampled_from([lambda leaf: leaf.tolist(), _base64]))
    observation = {f"leaf{index}": encode(np.full(shape, number)) for index, shape in enumerate(shapes)}
    document = {"observations": [observation] * rows, "seed": [2**63 - 1] * rows, "explore": True}
    return limits_of(shapes), rows, json.dumps(document, indent=indent).encode()


def _base64(leaf: NDArray) -> dict[str, Any]:
    return {"b64": base64.b64encode(leaf.tobytes()).decode(), "dtype": "float64", "shape": list(leaf.shape)}


@given(requests())
def test_valid_requests_are_within_the_limits(request: tuple[RequestLimits, int, bytes]) -> None:
    limits, rows, body = request
    limits.check_size(len(body), rows)
    limits.check_body(body, MAX_BATCH)
    limits.check_body(memoryview(body), MAX_BATCH)


def test_bodies_that_are_expensive_to_parse_are_rejected() -> None:
    """Half a megabyte, for a policy with four numbers in a list."""
    for part, what in (
        (b"[],", "lists and objects"),
        (b"[[1]],", "lists and objects"),
        (b"{},", "lists and objects"),
        (b"1,", "commas"),
        (b"1.000000000000000000,", "commas"),
    ):
        with pytest.raises(BodyTooLarge, match=f"{what}, expected at most"):
            limits_of([(4,)]).check_body(b"[" + part * (2**19 // len(part)), 1024)


def test_the_size_is_limited_by_the_number_of_observations() -> None:
    limits = limits_of([(4,)])
    limits.check_size(OVERHEAD_SIZE + limits.size, 1)
    with pytest.raises(BodyTooLarge, match=r"the body has \d+ bytes, expected at most \d+ for 1 observations"):
        limits.check_size(OVERHEAD_SIZE + limits.size + 1, 1)
    limits.check_size(OVERHEAD_SIZE + limits.size + 1, 2)
    with pytest.raises(BodyTooLarge, match=r"expected at most \d+ for 8 observations"):
        limits.check_body(b" " * 4 * LARGE_BODY, 8)
