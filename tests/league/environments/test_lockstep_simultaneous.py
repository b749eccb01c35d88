import itertools
from collections import defaultdict
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from league.config.environment import EnvironmentConfig
from league.environments.lockstep import stock_stepping
from league.environments.stepping import BatchedEnvironment, Turn, each_agent_alone
from league.errors import EnvironmentMismatch, IllegalAction, InvalidReward, LeagueError
from tests.support.environments.episodes import episodes
from tests.support.environments.simultaneous import RLlibSimultaneous, Simultaneous

HERE = "tests.support.environments.simultaneous"


def config(function: str = "meeting", **kwargs: Any) -> EnvironmentConfig:
    return EnvironmentConfig(entry_point=f"{HERE}:{function}", kwargs=kwargs)


def zeros(turn: Turn) -> dict[Any, np.ndarray]:
    return {group: np.zeros(len(batch), np.int64) for group, batch in turn.batches.items()}


def begin(env: BatchedEnvironment, seeds: list[int]) -> Turn:
    return env.start(each_agent_alone(seeds, len(env.agents)))


def reports(env: BatchedEnvironment, seed: int) -> dict[str, list[tuple[float, bool, bool]]]:
    """agent → (reward, terminated, truncated) of each of its reports in an episode of one environment."""
    found: dict[str, list[tuple[float, bool, bool]]] = defaultdict(list)
    turn = begin(env, [seed])
    while True:
        for ending in turn.each_ending():
            found[env.agents[ending.agent]].append((ending.reward, ending.terminated, ending.truncated))
        for group, batch in turn.batches.items():
            found[env.agents[group]].append((batch.rewards[0], False, False))
        if not turn.batches:
            return found
        turn = env.step(zeros(turn))


def test_termination_and_truncation_are_kept_apart() -> None:
    found = reports(stock_stepping(config(leaves=[3, 3, 3], truncated=[1], arrives=[0, 0, 0]), 1), seed=0)
    assert [flags[-1][1:] for flags in (found["agent_0"], found["agent_1"], found["agent_2"])] == [
        (True, False),
        (False, True),
        (True, False),
    ]


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_agents_join_and_leave_and_each_step_is_rewarded_once(data: st.DataObject) -> None:
    n = data.draw(st.integers(1, 4))
    leaves = data.draw(st.lists(st.integers(1, 6), min_size=n, max_size=n))
    # The first agent stays to the end, so that an agent is present at every step.
    leaves[0] = max(leaves)
    arrives = [0] + [data.draw(st.integers(0, leave - 1)) for leave in leaves[1:]]
    cut = sorted(data.draw(st.sets(st.integers(0, n - 1))))
    found = reports(stock_stepping(config(arrives=arrives, leaves=leaves, truncated=cut), 1), seed=3)
    for i, (come, leave) in enumerate(zip(arrives, leaves, strict=True)):
        own = found[f"agent_{i}"]
        assert len(own) == leave - come + 1
        assert [reward for reward, _, _ in own] == [0.0] + [10.0**i] * (leave - come)
        assert own[-1][1:] == (i not in cut, i in cut)
        assert all(report[1:] == (False, False) for report in own[:-1])


def test_episodes_do_not_depend_on_the_number_of_environments() -> None:
    one = [reports(stock_stepping(config(leaves=[2, 4]), 1), seed) for seed in range(5)]
    env = stock_stepping(config(leaves=[2, 4]), 3)
    turn = begin(env, list(range(5)))
    finished = len(turn.finished)
    rewards = 0.0
    while turn.batches:
        rewards += sum(sum(batch.rewards) for batch in turn.batches.values())
        turn = env.step(zeros(turn))
        rewards += sum(ending.reward for ending in turn.each_ending())
        finished += len(turn.finished)
    assert finished == 5
    assert rewards == sum(reward for episode in one for own in episode.values() for reward, _, _ in own)


@pytest.mark.parametrize("silent", [False, True])
@pytest.mark.parametrize("truncated", [False, True])
def test_rllibs_all_flag_ends_the_remaining_agents(silent: bool, truncated: bool) -> None:
    env = stock_stepping(config("rllib_meeting", ends=3, truncated=truncated, silent=silent), 1)
    turn = begin(env, [0])
    rows: dict[str, list[float]] = defaultdict(list)
    while turn.batches:
        (group,) = turn.batches
        rows[env.agents[group]].append(float(turn.batches[group].observations["observation"][0, 1]))
        turn = env.step(zeros(turn))
    assert rows == {"agent_0": [0.0, 2.0], "agent_1": [1.0]}
    endings = {env.agents[ending.agent]: ending for ending in turn.each_ending()}
    assert {agent: (e.terminated, e.truncated) for agent, e in endings.items()} == dict.fromkeys(
        env.agents, (not truncated, truncated)
    )
    assert {agent: e.reward for agent, e in endings.items()} == {"agent_0": 1.0, "agent_1": 20.0}
    # An agent without a last observation keeps the previous one.
    last = {agent: float(e.observation["observation"][1]) for agent, e in endings.items()}
    assert last == {"agent_0": 2.0, "agent_1": 1.0 if silent else 3.0}


def test_a_crash_affects_its_own_episode_only() -> None:
    env = stock_stepping(config(crashes=[1]), 2, crashes=1)
    turn = begin(env, [0, 1, 2])
    crashed, finished, ended = [], [], []
    while turn.batches:
        turn = env.step(zeros(turn))
        crashed += turn.crashed.tolist()
        finished += turn.finished.tolist()
        ended += turn.each_ending()
    assert crashed == [1]
    assert finished == [0, 1]
    assert len(ended) == 4


def test_only_consecutive_crashes_are_limited() -> None:
    env = stock_stepping(config(crashes=[0, 2, 4]), 1, crashes=1)
    turn, crashed = begin(env, list(range(6))), 0
    while turn.batches:
        turn = env.step(zeros(turn))
        crashed += len(turn.crashed)
    assert crashed == 3


class ReusedArrays(Simultaneous):
    """Writes all observations of an agent into one array."""

    def _observe(self, agent: str) -> np.ndarray:
        arrays = self.__dict__.setdefault("arrays", {})
        array = arrays.setdefault(agent, np.zeros(3, np.float32))
        array[:] = super()._observe(agent)
        return array


def test_the_last_observation_survives_the_next_reset() -> None:
    env = stock_stepping(EnvironmentConfig(entry_point=f"{__name__}:ReusedArrays", kwargs={"truncated": [0, 1]}), 1)
    turn = begin(env, [5, 6])
    while not turn.endings:
        turn = env.step(zeros(turn))
    assert turn.batches, "the next episode has begun"
    assert [ending.observation["observation"].tolist() for ending in turn.each_ending()] == [[0, 3, 5], [1, 3, 5]]


def test_an_environment_that_always_crashes_reraises() -> None:
    env = stock_stepping(config(crashes=list(range(10))), 1, crashes=2)
    turns = [env.start(each_agent_alone(itertools.count(), 2))]

    def play() -> None:
        for _ in range(20):
            turns.append(env.step(zeros(turns[-1])))

    with pytest.raises(RuntimeError, match="simulator is gone"):
        play()


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_reward_that_is_not_finite_is_rejected_despite_a_crash_budget(value: float) -> None:
    env = stock_stepping(config(bad_reward=value), 1, crashes=3)
    turn = begin(env, [12])
    with pytest.raises(InvalidReward, match=rf"agent_0 got a reward of {value} in the episode with seed 12"):
        env.step(zeros(turn))


def test_an_illegal_action_is_rejected_before_any_step() -> None:
    env = stock_stepping(config(), 2)
    turn = begin(env, [0, 1])
    actions = zeros(turn)
    actions[1][1] = 3
    with pytest.raises(IllegalAction, match="action 3 of agent_1"):
        env.step(actions)
    assert set(env.step(zeros(turn)).batches) == {0, 1}


def test_an_environment_without_rendering_is_reported() -> None:
    env = stock_stepping(EnvironmentConfig(entry_point="mpe2.simple_spread_v3"), 1)
    begin(env, [0])
    with pytest.raises(EnvironmentMismatch, match="cannot be rendered"):
        env.render(0)


def test_an_environment_is_rendered() -> None:
    env = stock_stepping(EnvironmentConfig(entry_point="mpe2.simple_spread_v3"), 1, render_mode="rgb_array")
    begin(env, [0])
    image = env.render(0)
    assert image.dtype == np.uint8
    assert image.ndim == 3
    assert image.shape[2] == 3
    env.close()


class RepeatedTermination(RLlibSimultaneous):
    """Reports the termination of an agent repeatedly, each time with an observation."""

    def step(self, actions: dict[str, int]) -> tuple[dict, ...]:
        self.time += 1
        seen = {agent: self._observe().copy() for agent in self.possible_agents}
        over = {"agent_0": True, "agent_1": False, "__all__": self.time == self.ends}
        return seen, {"agent_0": 1.0, "agent_1": 1.0}, over, {"__all__": False}, {}


def repeated_termination() -> RepeatedTermination:
    return RepeatedTermination()


def test_an_agent_terminates_once() -> None:
    env = stock_stepping(EnvironmentConfig(entry_point=f"{__name__}:repeated_termination"), 1)
    turn = begin(env, [0])
    left = []
    while turn.batches:
        turn = env.step(zeros(turn))
        left += [(env.agents[ending.agent], ending.reward) for ending in turn.each_ending()]
    assert sorted(left) == [("agent_0", 1.0), ("agent_1", 1.0)]


class NoAllFlag(RLlibSimultaneous):
    """All agents leave one by one, and the flag `__all__` is never set."""

    def step(self, actions: dict[str, int]) -> tuple[dict, ...]:
        self.time += 1
        assert self.time <= 2, "step without agents"
        agent = f"agent_{self.time - 1}"
        return {"agent_1": self._observe()}, {}, {agent: True, "__all__": False}, {"__all__": False}, {}


def no_all_flag() -> NoAllFlag:
    return NoAllFlag()


def test_an_episode_without_agents_is_over() -> None:
    env = stock_stepping(EnvironmentConfig(entry_point=f"{__name__}:no_all_flag"), 1)
    turn = begin(env, [0])
    finished = []
    while turn.batches:
        turn = env.step(zeros(turn))
        finished += turn.finished.tolist()
    assert finished == [0]


class ContractViolation(Simultaneous):
    """Violates the contract as `fault` says."""

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


def contract_violation(fault: str) -> ContractViolation:
    return ContractViolation(fault)


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("empty", "the episode with seed 5 ends at its reset"),
        ("mute", "agent_1 is in `agents`, but has no observation"),
        ("flown", "agent_1 has left the environment neither terminated nor truncated"),
        ("stranger", "'agent_7' has an observation, but is not in possible_agents"),
        ("misshapen", r"agent_1 observes observation with shape \[2\], but its space has \[3\]"),
    ],
)
@pytest.mark.parametrize("shared", [False, True])
def test_contract_violations_are_rejected_with_the_agent(fault: str, message: str, shared: bool) -> None:
    env = stock_stepping(
        EnvironmentConfig(entry_point=f"{__name__}:contract_violation", kwargs={"fault": fault}), 1, crashes=3
    )
    groups = [0, 0] if shared else [0, 1]
    with pytest.raises(LeagueError, match=message):
        env.step(zeros(env.start(episodes([5], groups))))
