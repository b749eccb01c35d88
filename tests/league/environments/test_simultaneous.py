import itertools
from collections import defaultdict
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from league.config import EnvironmentConfig
from league.environments.lockstep import stepping
from league.environments.stepping import BatchedEnvironment, Episode, Turn
from league.errors import EnvironmentMismatch, IllegalAction, InvalidReward, LeagueError
from tests.league.environments.simultaneous import Meeting, RLlibMeeting

HERE = "tests.league.environments.simultaneous"


def config(function: str = "meeting", **kwargs: Any) -> EnvironmentConfig:
    return EnvironmentConfig(entry_point=f"{HERE}:{function}", kwargs=kwargs)


def zeros(turn: Turn) -> dict[Any, np.ndarray]:
    return {group: np.zeros(len(batch.copies), np.int64) for group, batch in turn.batches.items()}


def begin(env: BatchedEnvironment, seeds: list[int]) -> Turn:
    queue = iter(seeds)
    return env.start(lambda _: None if (seed := next(queue, None)) is None else Episode(seed, env.agents))


def reports(env: BatchedEnvironment, seed: int) -> dict[str, list[tuple[float, bool, bool]]]:
    """agent → (reward, terminated, truncated) of each of its reports in one episode of one copy."""
    found: dict[str, list[tuple[float, bool, bool]]] = defaultdict(list)
    turn = begin(env, [seed])
    while True:
        for ending in turn.endings:
            found[env.agents[ending.agent]].append((ending.reward, ending.terminated, ending.truncated))
        for group, batch in turn.batches.items():
            found[group].append((batch.rewards[0], False, False))
        if not turn.batches:
            return found
        turn = env.step(zeros(turn))


def test_termination_and_truncation_in_one_step_stay_apart() -> None:
    found = reports(stepping(config(leaves=[3, 3, 3], truncated=[1], arrives=[0, 0, 0]), 1), seed=0)
    assert [flags[-1][1:] for flags in (found["agent_0"], found["agent_1"], found["agent_2"])] == [
        (True, False),
        (False, True),
        (True, False),
    ]


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_agents_come_and_go_and_each_step_is_paid_once(data: st.DataObject) -> None:
    n = data.draw(st.integers(1, 4))
    leaves = data.draw(st.lists(st.integers(1, 6), min_size=n, max_size=n))
    # Somebody is there at every step until the last leaves: the first agent stays to the end.
    leaves[0] = max(leaves)
    arrives = [0] + [data.draw(st.integers(0, leave - 1)) for leave in leaves[1:]]
    cut = sorted(data.draw(st.sets(st.integers(0, n - 1))))
    found = reports(stepping(config(arrives=arrives, leaves=leaves, truncated=cut), 1), seed=3)
    for i, (come, leave) in enumerate(zip(arrives, leaves, strict=True)):
        own = found[f"agent_{i}"]
        assert len(own) == leave - come + 1
        assert [reward for reward, _, _ in own] == [0.0] + [10.0**i] * (leave - come)
        assert own[-1][1:] == (i not in cut, i in cut)
        assert all(report[1:] == (False, False) for report in own[:-1])


def test_copies_do_not_change_an_episode() -> None:
    one = [reports(stepping(config(leaves=[2, 4]), 1), seed) for seed in range(5)]
    env = stepping(config(leaves=[2, 4]), 3)
    turn = begin(env, list(range(5)))
    finished = len(turn.finished)
    rewards = 0.0
    while turn.batches:
        rewards += sum(sum(batch.rewards) for batch in turn.batches.values())
        turn = env.step(zeros(turn))
        rewards += sum(ending.reward for ending in turn.endings)
        finished += len(turn.finished)
    assert finished == 5
    assert rewards == sum(reward for episode in one for own in episode.values() for reward, _, _ in own)


@pytest.mark.parametrize("silent", [False, True])
@pytest.mark.parametrize("truncated", [False, True])
def test_rllibs_all_flag_ends_everybody_who_is_left(silent: bool, truncated: bool) -> None:
    env = stepping(config("rllib_meeting", ends=3, truncated=truncated, silent=silent), 1)
    turn = begin(env, [0])
    rows: dict[str, list[float]] = defaultdict(list)
    while turn.batches:
        (agent,) = turn.batches
        rows[agent].append(float(turn.batches[agent].observations["observation"][0, 1]))
        turn = env.step(zeros(turn))
    assert rows == {"agent_0": [0.0, 2.0], "agent_1": [1.0]}
    endings = {env.agents[ending.agent]: ending for ending in turn.endings}
    assert {agent: (e.terminated, e.truncated) for agent, e in endings.items()} == dict.fromkeys(
        env.agents, (not truncated, truncated)
    )
    assert {agent: e.reward for agent, e in endings.items()} == {"agent_0": 1.0, "agent_1": 20.0}
    # Who has no last observation keeps the one before.
    last = {agent: float(e.observation["observation"][1]) for agent, e in endings.items()}
    assert last == {"agent_0": 2.0, "agent_1": 1.0 if silent else 3.0}


def test_a_crash_costs_its_own_episode_only() -> None:
    env = stepping(config(crashes=[1]), 2, crashes=1)
    seeds = itertools.chain([0, 1, 2], itertools.repeat(None))
    turn = env.start(lambda _: None if (seed := next(seeds)) is None else Episode(seed, env.agents))
    crashed, finished, ended = [], [], []
    while turn.batches:
        turn = env.step(zeros(turn))
        crashed += turn.crashed
        finished += turn.finished
        ended += turn.endings
    assert crashed == [1]
    assert finished == [0, 1]
    assert len(ended) == 4


def test_a_copy_that_always_crashes_raises_what_it_raised() -> None:
    env = stepping(config(crashes=list(range(10))), 1, crashes=2)
    seeds = itertools.count()
    turns = [env.start(lambda _: Episode(next(seeds), env.agents))]

    def play() -> None:
        for _ in range(20):
            turns.append(env.step(zeros(turns[-1])))

    with pytest.raises(RuntimeError, match="simulator is gone"):
        play()


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_reward_that_is_no_number_is_refused_by_name_even_where_crashes_are_survived(value: float) -> None:
    env = stepping(config(bad_reward=value), 1, crashes=3)
    turn = begin(env, [12])
    with pytest.raises(InvalidReward, match=rf"agent_0 got a reward of {value} in the episode of seed 12"):
        env.step(zeros(turn))


def test_an_illegal_action_is_refused_before_anything_moves() -> None:
    env = stepping(config(), 2)
    turn = begin(env, [0, 1])
    wrong = zeros(turn)
    wrong["agent_1"][1] = 3
    with pytest.raises(IllegalAction, match="action 3 of agent_1"):
        env.step(wrong)
    assert set(env.step(zeros(turn)).batches) == {"agent_0", "agent_1"}


def test_an_environment_without_pictures_says_so() -> None:
    env = stepping(EnvironmentConfig(entry_point="mpe2.simple_spread_v3"), 1)
    begin(env, [0])
    with pytest.raises(EnvironmentMismatch, match="no picture"):
        env.render(0)


def test_a_picture_of_a_copy() -> None:
    env = stepping(EnvironmentConfig(entry_point="mpe2.simple_spread_v3"), 1, render_mode="rgb_array")
    begin(env, [0])
    picture = env.render(0)
    assert picture.dtype == np.uint8
    assert picture.ndim == 3
    assert picture.shape[2] == 3
    env.close()


class Revenant(RLlibMeeting):
    """An agent that is told again and again that it has left, with an observation each time."""

    def step(self, actions: dict[str, int]) -> tuple[dict, ...]:
        self.time += 1
        seen = {agent: self._observe().copy() for agent in self.possible_agents}
        over = {"agent_0": True, "agent_1": False, "__all__": self.time == self.ends}
        return seen, {"agent_0": 1.0, "agent_1": 1.0}, over, {"__all__": False}, {}


def revenant() -> Revenant:
    return Revenant()


def test_an_agent_leaves_once() -> None:
    env = stepping(EnvironmentConfig(entry_point=f"{__name__}:revenant"), 1)
    turn = begin(env, [0])
    left = []
    while turn.batches:
        turn = env.step(zeros(turn))
        left += [(env.agents[ending.agent], ending.reward) for ending in turn.endings]
    assert sorted(left) == [("agent_0", 1.0), ("agent_1", 1.0)]


class Deserted(RLlibMeeting):
    """All agents leave one by one, and nobody says that the episode is over."""

    def step(self, actions: dict[str, int]) -> tuple[dict, ...]:
        self.time += 1
        assert self.time <= 2, "nobody is left to step for"
        agent = f"agent_{self.time - 1}"
        return {"agent_1": self._observe()}, {}, {agent: True, "__all__": False}, {"__all__": False}, {}


def deserted() -> Deserted:
    return Deserted()


def test_an_episode_that_everybody_has_left_is_over() -> None:
    env = stepping(EnvironmentConfig(entry_point=f"{__name__}:deserted"), 1)
    turn = begin(env, [0])
    finished = []
    while turn.batches:
        turn = env.step(zeros(turn))
        finished += turn.finished
    assert finished == [0]


class Misfit(Meeting):
    """What it does wrong is in `fault`."""

    def __init__(self, fault: str) -> None:
        super().__init__()
        self.fault = fault

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        seen, infos = super().reset(seed, options)
        return ({}, {}) if self.fault == "empty" else (seen, infos)

    def step(self, actions: dict[str, int]) -> tuple[dict, ...]:
        seen, *rest = super().step(actions)
        match self.fault:
            case "mute":
                del seen["agent_1"]
            case "flown":
                self.agents = ["agent_0"]
            case "stranger":
                seen["agent_7"] = seen["agent_0"]
            case "misshapen":
                seen["agent_1"] = seen["agent_1"][:2]
        return seen, *rest


def misfit(fault: str) -> Misfit:
    return Misfit(fault)


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("empty", "nobody acts in the episode of seed 5"),
        ("mute", "agent_1 is among the agents, but has no observation"),
        ("flown", "agent_1 has left the environment neither terminated nor truncated"),
        ("stranger", "'agent_7' has an observation, but is not among possible_agents"),
        ("misshapen", r"agent_1 observes observation of shape \[2\], its space says \[3\]"),
    ],
)
@pytest.mark.parametrize("shared", [False, True])
def test_what_breaks_the_contract_is_refused_with_its_agent(fault: str, message: str, shared: bool) -> None:
    env = stepping(EnvironmentConfig(entry_point=f"{__name__}:misfit", kwargs={"fault": fault}), 1, crashes=3)
    groups = ("all", "all") if shared else env.agents
    with pytest.raises(LeagueError, match=message):
        env.step(zeros(env.start(lambda _: Episode(5, groups))))
