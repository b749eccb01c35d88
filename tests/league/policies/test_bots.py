"""Bots as policies."""

import numpy as np
import pytest

from league.errors import ConfigError, EnvironmentMismatch
from league.policies.bots import INSTANCE, Bot
from league.policies.policy import MalformedAction
from league.policies.scripted import script
from league.spaces import Box, DictSpace, Discrete
from tests.support.policies.bots import MODULE

BOARD = Box(dtype="int8", shape=(3,), low=0, high=1)


OBSERVATION = DictSpace(spaces={"observation": BOARD, "action_mask": Box(dtype="int8", shape=(4,), low=0, high=1)})


ACTION = Discrete(n=4)


MASKS = np.array([[0, 1, 1, 1], [1, 0, 0, 1]], np.int8)


BATCH = {"observation": np.zeros((2, 3), np.int8), "action_mask": MASKS}


def bot(name: str) -> Bot:
    return Bot(f"{MODULE}:{name}", OBSERVATION, ACTION)


def generators(seed: int = 0) -> list[np.random.Generator]:
    return [np.random.default_rng((seed, row)) for row in range(2)]


def test_an_instance_plays_one_agent_for_one_episode() -> None:
    policy = bot("Alternating")
    once = policy.act(BATCH)
    twice = policy.act(BATCH, state=once.state)
    assert (once.actions.tolist(), twice.actions.tolist()) == ([3, 3], [1, 0])
    assert twice.state is not None
    fresh = {INSTANCE: np.array([twice.state[INSTANCE][0], 0], dtype=object)}
    assert policy.act(BATCH, state=fresh).actions.tolist() == [3, 3]


def test_an_exception_is_a_fault_of_its_row() -> None:
    policy = bot("Failing")
    state = policy.act(BATCH).state
    assert state is not None
    state = {INSTANCE: np.array([0, state[INSTANCE][1]], dtype=object)}
    for _ in range(2):
        answer = policy.act(BATCH, state=state)
        state = answer.state
    assert answer.actions[0] == 1
    assert [(row, str(fault)) for row, fault in answer.faults.items()] == [(1, "no idea")]


def test_nested_observations_keep_their_keys() -> None:
    space = DictSpace(spaces={"map": BOARD, "unit": DictSpace(spaces={"hp": Discrete(n=5)})})
    policy = Bot(f"{__name__}:hit_points", space, ACTION)
    batch = {"observation.map": np.zeros((2, 3), np.int8), "observation.unit.hp": np.array([1, 3])}
    assert policy.act(batch).actions.tolist() == [1, 3]


def hit_points(observation: dict) -> int:
    return observation["unit"]["hp"]


def test_functions_act_row_by_row_or_on_batches() -> None:
    for name in ("first", "all_at_once"):
        assert bot(name).act(BATCH).actions.tolist() == [1, 0]
    both = bot("sampled").act(BATCH, rng=generators()).actions
    second = {name: array[1:] for name, array in BATCH.items()}
    assert bot("sampled").act(second, rng=generators()[1:]).actions.tolist() == [both[1]], "by its own generator"
    faults = bot("text").act(BATCH).faults
    assert all(isinstance(fault, MalformedAction) for fault in faults.values())
    assert "returned str 'left': expected int64" in str(faults[1])


def test_what_is_not_a_bot_is_rejected() -> None:
    for name, message in (
        (f"{MODULE}:missing", "bots.py\\) has no 'missing'"),
        (f"{MODULE}:NOT_A_BOT", "is a int: expected a function, or a class with a method `act`"),
        (f"{MODULE}:needs_more", "requires 'depth': expected the arguments observation, action_mask and rng"),
        ("no_such_module:act", "cannot import 'no_such_module': .*; searched: "),
    ):
        with pytest.raises(ConfigError, match=f"script:{name}.*{message}"):
            script(name, OBSERVATION, ACTION)
    with pytest.raises(EnvironmentMismatch, match="dict actions"):
        Bot(f"{MODULE}:first", OBSERVATION, DictSpace(spaces={"a": ACTION}))
