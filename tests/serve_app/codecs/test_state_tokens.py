"""Recurrent state as a token: it survives encoding, and is valid for its policy and version only."""

import re
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from league.errors import InvalidState
from league.refs import MAX_VERSION
from league.spaces import Box, Leaf
from serve_app.codecs.state_tokens import StateToken, common_version, read_state, read_token, write_tokens
from tests.support.examples import examples

MODEL, SHA256 = "memory.shared", "ab" * 32
LEAVES: list[tuple[str, Leaf]] = [
    ("state_in_0", Box(dtype="float32", shape=(2, 3), low=None, high=None)),
    ("state_in_1", Box(dtype="int16", shape=(), low=None, high=None)),
]
finite = st.floats(width=32, allow_nan=False, allow_infinity=False)


def states(rows: int) -> st.SearchStrategy[dict[str, NDArray]]:
    return st.fixed_dictionaries(
        {
            "state_in_0": arrays(np.float32, (rows, 2, 3), elements=finite),
            "state_in_1": arrays(np.int16, (rows,)),
        }
    )


def some_state(rows: int = 1) -> dict[str, NDArray]:
    numbers = np.arange(6 * rows, dtype=np.float32).reshape(rows, 2, 3)
    return {"state_in_0": numbers, "state_in_1": np.arange(rows, dtype=np.int16)}


def token(version: int = 7, state: dict[str, NDArray] | None = None, model: str = MODEL, sha256: str = SHA256) -> str:
    return write_tokens(model, version, sha256, some_state() if state is None else state)[0]


@given(data=st.data(), rows=st.integers(1, 4), version=st.integers(1, MAX_VERSION))
def test_a_state_survives_encoding(data: st.DataObject, rows: int, version: int) -> None:
    state = data.draw(states(rows))
    texts = write_tokens(MODEL, version, SHA256, state)
    tokens = [read_token(text) for text in texts]
    assert len(texts) == rows
    assert all(re.fullmatch(r"[A-Za-z0-9_-]+", text) for text in texts)
    assert {(each.model, each.version) for each in tokens} == {(MODEL, version)}
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


@pytest.mark.parametrize("text", ["", "a", "abcd", "****", "Ä" * 40, "a" * 200, "=" * 40, "\0", "\n" * 4, "🎲" * 9])
def test_an_invalid_token_is_rejected(text: str) -> None:
    with pytest.raises(InvalidState, match="not a complete token of an earlier response"):
        read_token(text)


@pytest.mark.parametrize("value", [3, 1.5, True, [], ["a"], {}, b"a", [[1.0]]])
def test_a_token_must_be_a_string(value: Any) -> None:
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


@pytest.mark.parametrize(
    ("given_token", "message"),
    [
        (token(model="memory.other"), "is of memory.other, expected memory.shared"),
        (token(model="memories.shared"), "is of memories.shared"),
        (token(sha256="cd" * 32), "a different version 7 of memory.shared than the one in this registry"),
        (token(state={"state_in_0": np.zeros((1, 2, 3), np.float32)}), "has 24 bytes, expected 26"),
        (token(state={"state_in_0": np.zeros((1, 7), np.float32)}), "has 28 bytes, expected 26"),
        (token(state=some_state() | {"state_in_0": np.full((1, 2, 3), np.nan, np.float32)}), "NaN"),
        (token(state=some_state() | {"state_in_0": np.full((1, 2, 3), np.inf, np.float32)}), "infinity"),
    ],
)
def test_a_token_of_another_policy_is_rejected(given_token: str, message: str) -> None:
    with pytest.raises(InvalidState, match=message):
        read_state([read_token(given_token)], MODEL, SHA256, LEAVES)


def test_tokens_of_several_versions_cannot_be_combined() -> None:
    tokens: list[StateToken] = [read_token(token(version)) for version in (3, 2, 3)]
    with pytest.raises(InvalidState, match="several versions \\(2, 3\\)"):
        common_version(tokens)
