"""What is asked for, as far as it can be told without the policy."""

from typing import Any

import numpy as np
import pytest

from league.errors import BodyTooLarge, InvalidInput, InvalidReference, InvalidState, LeagueError
from serve_app.asks import KEYS, pinned_version, read_ask, refuse_unknown
from serve_app.tokens import write_tokens


def token(version: int, model: str = "memory.shared") -> str:
    return write_tokens(model, version, "ab" * 32, {"state_in_0": np.zeros((1, 1), np.float32)})[0]


def test_one_observation_is_a_batch_of_one() -> None:
    ask = read_ask({"observation": [1, 2]}, max_batch=8)
    assert (ask.observations, ask.is_batch, ask.explore, ask.seed, ask.probabilities) == (
        [[1, 2]],
        False,
        False,
        None,
        False,
    )
    assert (ask.state, ask.tokens, ask.strings) == (None, None, 1)


def test_all_that_may_be_asked_for() -> None:
    document = {
        "observations": [1, 2],
        "explore": True,
        "seed": [3, 4],
        "probabilities": True,
        "state": [token(7), None],
    }
    ask = read_ask(document, max_batch=8)
    assert (ask.is_batch, ask.explore, ask.seed, ask.probabilities) == (True, True, [3, 4], True)
    assert ask.tokens is not None
    assert [each and each.version for each in ask.tokens] == [7, None]
    assert ask.strings == 6, "five keys and a token"


def test_state_as_arrays() -> None:
    ask = read_ask({"observation": 1, "state": {"state_in_0": [[1.0]]}}, max_batch=8)
    assert (ask.state, ask.tokens, ask.strings) == ({"state_in_0": [[1.0]]}, None, 3)
    assert read_ask({"observation": 1, "state": {}}, max_batch=8).state == {}


@pytest.mark.parametrize(
    ("document", "error", "words"),
    [
        ({}, InvalidInput, "neither observation nor observations"),
        ({"observation": 1, "observations": [1]}, InvalidInput, "both observation and observations"),
        ({"observations": 1}, InvalidInput, "observations is a number"),
        ({"observations": []}, InvalidInput, "empty"),
        ({"observations": [1] * 9}, BodyTooLarge, "holds 9, expected at most 8"),
        ({"observation": 1, "explore": None}, InvalidInput, "explore is null, expected true or false"),
        ({"observation": 1, "probabilities": 1}, InvalidInput, "probabilities is a number"),
        ({"observation": 1, "probabilities": "yes"}, InvalidInput, "probabilities is a string"),
        ({"observation": 1, "seed": True}, InvalidInput, "seed must be"),
        ({"observation": 1, "seed": 2**63}, InvalidInput, "seed must be"),
        ({"observation": 1, "seed": [1]}, InvalidInput, "seed must be"),
        ({"observations": [1, 2], "seed": [1]}, InvalidInput, "seed holds 1 integers, expected 2"),
        ({"observations": [1, 2], "seed": [1, "2"]}, InvalidInput, "seed must be"),
        ({"observation": 1, "state": 3}, InvalidState, "a string for each observation"),
        ({"observation": 1, "state": [token(7)]}, InvalidState, "a string for each observation"),
        ({"observations": [1], "state": token(7)}, InvalidState, "state is a string, expected a list"),
        ({"observations": [1, 2], "state": [token(7)]}, InvalidState, "state holds 1, expected 2"),
        ({"observations": [1, 2], "state": [token(7), "x"]}, InvalidState, "no token"),
        ({"observations": [1, 2], "state": [token(7), {}]}, InvalidState, "a string for each observation"),
    ],
)
def test_what_cannot_be_meant(document: dict[str, Any], error: type[LeagueError], words: str) -> None:
    with pytest.raises(error, match=words):
        read_ask(document, max_batch=8)


def test_an_unknown_key() -> None:
    refuse_unknown({"observation": 1, "state": None}, KEYS)
    with pytest.raises(InvalidInput, match="unknown key 'proabilities', expected explore, observation"):
        refuse_unknown({"observation": 1, "proabilities": True}, KEYS)


def pinned(state: Any, asked: str, model: str = "memory") -> str:
    return pinned_version(read_ask({"observations": [1] * len(state), "state": state}, max_batch=8), model, asked)


def test_a_token_says_which_version_answers() -> None:
    assert pinned([None], "champion") == "champion"
    assert pinned([token(7)], "champion") == "7"
    assert pinned([token(7)], "7") == "7"
    assert pinned([None, token(7), None, token(7)], "candidate", "memory.shared") == "7"
    assert pinned_version(read_ask({"observation": 1}, max_batch=8), "memory", "champion") == "champion"


@pytest.mark.parametrize(
    ("state", "asked", "model", "error", "words"),
    [
        ([token(7)], "8", "memory", InvalidState, "of version 7, and version 8 is asked for"),
        ([token(7), token(8)], "champion", "memory", InvalidState, "several versions"),
        ([token(7)], "Champion", "memory", InvalidReference, "must consist of"),
        ([token(7)], "champion", "other", InvalidState, "is of memory.shared, not of other"),
        ([None, token(7)], "7", "mem", InvalidState, "not of mem"),
    ],
)
def test_what_contradicts_a_token(state: Any, asked: str, model: str, error: type[LeagueError], words: str) -> None:
    with pytest.raises(error, match=words):
        pinned(state, asked, model)
