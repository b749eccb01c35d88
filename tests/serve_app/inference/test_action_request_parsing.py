"""Parsing of action requests, before the policy is known."""

from typing import Any

import numpy as np
import pytest

from league.errors import BodyTooLarge, InvalidInput, InvalidReference, InvalidState, LeagueError
from serve_app.codecs.state_tokens import write_tokens
from serve_app.inference.action_request import KEYS, parse_action_request, pinned_version, reject_unknown_keys


def token(version: int, model: str = "memory.shared") -> str:
    return write_tokens(model, version, "ab" * 32, {"state_in_0": np.zeros((1, 1), np.float32)})[0]


def test_one_observation_is_a_batch_of_one() -> None:
    request = parse_action_request({"observation": [1, 2]}, max_batch=8)
    assert (request.observations, request.is_batch, request.explore, request.seed, request.probabilities) == (
        [[1, 2]],
        False,
        None,
        None,
        False,
    )
    assert (request.state, request.tokens, request.strings) == (None, None, 1)


def test_all_options_are_parsed() -> None:
    document = {
        "observations": [1, 2],
        "explore": True,
        "seed": [3, 4],
        "probabilities": True,
        "state": [token(7), None],
    }
    ask = parse_action_request(document, max_batch=8)
    assert (ask.is_batch, ask.explore, ask.seed, ask.probabilities) == (True, True, [3, 4], True)
    assert ask.tokens is not None
    assert [each and each.version for each in ask.tokens] == [7, None]
    assert ask.strings == 6, "five keys, one token"


def test_state_can_be_arrays() -> None:
    request = parse_action_request({"observation": 1, "state": {"state_in_0": [[1.0]]}}, max_batch=8)
    assert (request.state, request.tokens, request.strings) == ({"state_in_0": [[1.0]]}, None, 3)
    assert parse_action_request({"observation": 1, "state": {}}, max_batch=8).state == {}


@pytest.mark.parametrize(
    ("document", "error", "message"),
    [
        ({}, InvalidInput, "neither observation nor observations"),
        ({"observation": 1, "observations": [1]}, InvalidInput, "both observation and observations"),
        ({"observations": 1}, InvalidInput, "observations is a number"),
        ({"observations": []}, InvalidInput, "empty"),
        ({"observations": [1] * 9}, BodyTooLarge, "has 9 items, expected at most 8"),
        ({"observation": 1, "explore": None}, InvalidInput, "explore is null, expected true or false"),
        ({"observation": 1, "probabilities": 1}, InvalidInput, "probabilities is a number"),
        ({"observation": 1, "probabilities": "yes"}, InvalidInput, "probabilities is a string"),
        ({"observation": 1, "seed": True}, InvalidInput, "seed must be"),
        ({"observation": 1, "seed": 2**63}, InvalidInput, "seed must be"),
        ({"observation": 1, "seed": [1]}, InvalidInput, "seed must be"),
        ({"observations": [1, 2], "seed": [1]}, InvalidInput, "seed has 1 integers, expected 2"),
        ({"observations": [1, 2], "seed": [1, "2"]}, InvalidInput, "seed must be"),
        ({"observation": 1, "state": 3}, InvalidState, "one string per observation"),
        ({"observation": 1, "state": [token(7)]}, InvalidState, "one string per observation"),
        ({"observations": [1], "state": token(7)}, InvalidState, "state is a string, expected a list"),
        ({"observations": [1, 2], "state": [token(7)]}, InvalidState, "state has 1 items, expected 2"),
        ({"observations": [1, 2], "state": [token(7), "x"]}, InvalidState, "not a complete token"),
        ({"observations": [1, 2], "state": [token(7), {}]}, InvalidState, "one string per observation"),
    ],
)
def test_invalid_requests_are_rejected(document: dict[str, Any], error: type[LeagueError], message: str) -> None:
    with pytest.raises(error, match=message):
        parse_action_request(document, max_batch=8)


def test_an_unknown_key_is_rejected() -> None:
    reject_unknown_keys({"observation": 1, "state": None}, KEYS)
    with pytest.raises(InvalidInput, match="unknown key 'proabilities', expected analysis, deadline_ms, explore"):
        reject_unknown_keys({"observation": 1, "proabilities": True}, KEYS)


def pinned(state: Any, version: str, model: str = "memory") -> str:
    return pinned_version(
        parse_action_request({"observations": [1] * len(state), "state": state}, max_batch=8), model, version
    )


def test_a_token_selects_the_version() -> None:
    assert pinned([None], "champion") == "champion"
    assert pinned([token(7)], "champion") == "7"
    assert pinned([token(7)], "7") == "7"
    assert pinned([None, token(7), None, token(7)], "candidate", "memory.shared") == "7"
    assert pinned_version(parse_action_request({"observation": 1}, max_batch=8), "memory", "champion") == "champion"


@pytest.mark.parametrize(
    ("state", "version", "model", "error", "message"),
    [
        ([token(7)], "8", "memory", InvalidState, "of version 7, but the request is for version 8"),
        ([token(7), token(8)], "champion", "memory", InvalidState, "several versions"),
        ([token(7)], "Champion", "memory", InvalidReference, "must consist of"),
        ([token(7)], "champion", "other", InvalidState, "is of memory.shared, expected other"),
        ([None, token(7)], "7", "mem", InvalidState, "expected mem"),
    ],
)
def test_a_contradiction_to_a_token_is_rejected(
    state: Any, version: str, model: str, error: type[LeagueError], message: str
) -> None:
    with pytest.raises(error, match=message):
        pinned(state, version, model)
