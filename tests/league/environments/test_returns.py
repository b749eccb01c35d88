"""What is said about environments whose `reset` or `step` return something else than their API requires."""

import re
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from league.config.environment import EnvironmentConfig
from league.config.league import LeagueConfig
from league.environments.conformance.examination import examine
from league.environments.implementation import stock_stepping
from league.environments.stepping import each_agent_alone
from league.errors import InvalidReturn
from tests.support.environments.masked import AGENTS, ParallelMasked, RLlibMasked, TurnMasked

CHANGES: dict[str, Any] = {
    "rewards None": lambda parts: (parts[0], None, *parts[2:]),
    "a reward None": lambda parts: (parts[0], {"ann": 1.0, "bob": None}, *parts[2:]),
    "a reward array": lambda parts: (parts[0], {"ann": 1.0, "bob": np.array([1.0])}, *parts[2:]),
    "rewards list": lambda parts: (parts[0], [1.0, 1.0], *parts[2:]),
    "four values": lambda parts: (parts[0], parts[1], parts[2], parts[4]),
    "raises": lambda parts: 1 / 0,
    "flag array": lambda parts: (*parts[:2], {agent: [False] for agent in AGENTS}, *parts[3:]),
    "no infos": lambda parts: (*parts[:4], None),
    "no observation": lambda parts: ({**parts[0], "bob": None}, *parts[1:]),
    "another mask": lambda parts: (
        {**parts[0], "bob": parts[0]["bob"] | {"action_mask": np.ones(2, np.int8)}},
        *parts[1:],
    ),
    "another key": lambda parts: ({**parts[0], "bob": {"x": 1}}, *parts[1:]),
}


class WrongParallel(ParallelMasked):
    def __init__(self, change: str) -> None:
        super().__init__("obs")
        self.change = change

    def reset(self, seed: int | None = None, options: Any = None) -> Any:
        observations, infos = super().reset(seed)
        return observations if self.change == "one value" else (observations, infos)

    def step(self, actions: dict[str, Any]) -> Any:
        parts = super().step(actions)
        if self.change == "done":
            self.agents = []
            return parts[0], parts[1], {"__all__": True}, {}, parts[4]
        return CHANGES.get(self.change, lambda parts: parts)(parts)


class WrongRLlib(RLlibMasked):
    def __init__(self, change: str) -> None:
        super().__init__(space="obs")
        self.change = change

    def step(self, actions: dict[str, Any]) -> Any:
        return CHANGES[self.change](super().step(actions))


class WrongTurns(TurnMasked):
    def __init__(self, change: str) -> None:
        super().__init__("obs")
        self.change = change

    def last(self, observe: bool = True) -> Any:
        value, reward, *flags, info = super().last(observe)
        return (value, reward, flags[0], info) if self.change == "four values" else (value, None, *flags, info)


STEP = "observations, rewards, terminations, truncations, infos"


def config(cls: type, **settings: Any) -> EnvironmentConfig:
    return EnvironmentConfig(entry_point=f"{__name__}:{cls.__name__}", **settings)


def fault(cls: type, change: str, **settings: Any) -> str:
    """The only finding."""
    environment = config(cls, kwargs={"change": change}, **settings)
    (finding,) = examine(LeagueConfig(league="x", environment=environment), episodes=1).findings
    return str(finding)


def test_check_env_says_what_was_returned_by_whom_and_what_was_expected(subtests: pytest.Subtests) -> None:
    for cls, change, message in (
        (WrongParallel, "rewards None", r"step returned None as rewards: expected a dictionary by agent \(step 1 of"),
        (WrongParallel, "a reward None", r"agent bob got the reward None: expected a number \(step 1 of the episode"),
        (WrongParallel, "a reward array", r"agent bob got the reward array\(\[1.\]\) \(ndarray\): expected a number"),
        (WrongParallel, "rewards list", r"step returned \[1.0, 1.0\] \(list\) as rewards: expected a dictionary by"),
        (WrongParallel, "four values", rf"step returned 4 values: expected {STEP} \(the former dones are"),
        (WrongParallel, "one value", r"reset returned one dict: expected observations, infos \(reset with seed 0\)"),
        (WrongParallel, "flag array", r"step returned \[False\] \(list\) as a flag of ann: expected True or"),
        (WrongParallel, "no infos", "step returned None as infos: expected a dictionary by agent"),
        (WrongParallel, "no observation", "bob observes NoneType, but its space is Dict"),
        (WrongParallel, "another mask", r"bob observes action_mask with shape \[2\], but its space has \[3\]"),
        (WrongParallel, "another key", "bob observes a dict with x, but its space is Dict"),
        (WrongParallel, "done", "has left the environment neither terminated nor truncated: both need its key"),
        (WrongRLlib, "a reward None", "agent bob got the reward None: expected a number"),
        (WrongRLlib, "four values", rf"step returned 4 values: expected {STEP}"),
        (WrongTurns, "a reward None", "agent ann got the reward None: expected a number"),
        (WrongTurns, "four values", "last returned 4 values: expected observation, reward, termination, truncation"),
    ):
        with subtests.test(environment=cls.__name__, change=change):
            text = fault(cls, change)
            assert "raised an exception" not in text
            assert re.search(message, text), text


def test_check_env_says_what_a_wrapper_failed_on(subtests: pytest.Subtests) -> None:
    for change, message in (
        ("a reward None", "agent bob got the reward None: expected a number (below its wrappers, "),
        ("four values", f"step returned 4 values: expected {STEP}"),
        ("raises", "the environment raised an exception"),
    ):
        with subtests.test(change=change):
            text = fault(WrongParallel, change, wrappers=("clip_reward_v0",))
            assert message in text
            assert ("raised an exception" in text) == ("division by zero" in text) == (change == "raises")


def test_training_says_it_too(subtests: pytest.Subtests) -> None:
    for change, message in (
        ("a reward array", r"bob got the reward array\(\[1.\]\) \(ndarray\): expected a number, in the episode with"),
        ("four values", r"step returned 4 values: expected .*, in the episode with seed 5"),
        ("another key", r"agent bob observes {'x': 1} \(dict\): expected the keys of its observation space, in the"),
        ("one value", "reset returned one dict: expected observations, infos, in the episode"),
    ):
        stepping = stock_stepping(config(WrongParallel, kwargs={"change": change}), 1, crashes=3)
        with subtests.test(change=change), pytest.raises(InvalidReturn, match=message):
            stepping.step(dict.fromkeys(stepping.start(each_agent_alone([5], 2)).batches, np.zeros(1, np.int64)))


class BinaryActions(ParallelMasked):
    def __init__(self) -> None:
        super().__init__("obs")
        self.action_spaces = dict.fromkeys(AGENTS, spaces.MultiBinary(3))


def test_actions_that_cannot_be_learnt_are_refused_before_any_game() -> None:
    (finding,) = examine(LeagueConfig(league="x", environment=config(BinaryActions)), episodes=1).findings
    assert str(finding) == (
        "ann and 1 more: has an unsupported action space: expected Discrete, MultiDiscrete or a Box of floats"
    )
