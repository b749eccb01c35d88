"""Lockstep equals the plain loop of each API, for unmodified environments. Episodes depend only on their seeds: not on
the environment's index, its earlier episodes, or the other environments.
"""

import importlib
import itertools
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pettingzoo.classic import tictactoe_v3
from pettingzoo.utils.wrappers import TerminateIllegalWrapper
from ray.rllib.env.multi_agent_env import MultiAgentEnv

from league.config.environment import EnvironmentConfig
from league.environments.apis import RLlibEnv
from league.environments.building import build
from league.environments.copies import StockCopies
from league.environments.implementation import stock_stepping
from league.environments.lockstep import Lockstep
from league.environments.stepping import BatchedEnvironment, Turn, each_agent_alone
from league.errors import ConfigError, EnvironmentMismatch, IllegalAction, InvalidReward
from tests.conformance.stepping import (
    assert_same_episode,
    assert_stepping_conforms,
    lockstep,
    states_of,
)
from tests.support.environments import engines
from tests.support.environments.cases import CASES, Case
from tests.support.environments.episodes import episodes
from tests.support.environments.simultaneous import RLlibSimultaneous, Simultaneous, meeting


def test_environments_are_closed_if_a_further_one_cannot_be_created() -> None:
    """With a fixed port, for example."""
    environment = EnvironmentConfig(entry_point=f"{engines.__name__}:engine", kwargs={"most": 2})
    with pytest.raises(ConfigError, match="OSError: Address already in use"):
        stock_stepping(environment, 3)
    assert engines.RUNNING == []


def config(function: str = "meeting", **kwargs: Any) -> EnvironmentConfig:
    return EnvironmentConfig(entry_point=f"{SUPPORT}simultaneous:{function}", kwargs=kwargs)


def of_class(cls: type, **kwargs: Any) -> EnvironmentConfig:
    return EnvironmentConfig(entry_point=f"{__name__}:{cls.__name__}", kwargs=kwargs)


def turns_until_the_end(env: BatchedEnvironment, turn: Turn) -> Iterator[Turn]:
    """Of play with the first actions."""
    yield turn
    while turn.batches:
        turn = env.step(zeros(turn))
        yield turn


def test_groups_can_change_within_an_episode_and_share_a_batch() -> None:
    env = stock_stepping(EnvironmentConfig(entry_point=COUNTING, kwargs={"lives": [2, 2]}), num_envs=1)
    turn = env.start(episodes([0], [7, 7]))
    assert list(turn.batches) == [7]
    env.assign(np.array([0]), np.array([[1, 2]]))
    assert list(env.step({7: np.array([0])}).batches) == [2]
    env = stock_stepping(EnvironmentConfig(entry_point=f"{CLASSIC}connect_four_v3"), num_envs=5)
    batch = env.start(episodes(range(5), [3, 3])).batches[3]
    assert batch.envs.tolist() == [0, 1, 2, 3, 4]
    assert batch.observations["observation"].shape == (5, 6, 7, 2)
    assert batch.observations["action_mask"].dtype == np.int8


def test_an_illegal_action_is_rejected_before_any_step() -> None:
    env = stock_stepping(EnvironmentConfig(entry_point=f"{CLASSIC}tictactoe_v3"), num_envs=2)
    begin(env, [0, 0])
    for action in (9, -1):
        with pytest.raises(IllegalAction, match=rf"action {action} of player_1 is illegal"):
            env.step({0: np.array([0, action])})
    turn = env.step({0: np.array([4, 4])})
    assert (turn.batches[1].observations["observation"].sum(axis=(1, 2, 3)) == 1).all()
    with pytest.raises(IllegalAction, match="action_mask is"):
        env.step({1: np.array([4, 0])})


def test_checking_wrappers_are_removed_and_others_kept() -> None:
    assert not isinstance(build(EnvironmentConfig(entry_point=f"{CLASSIC}connect_four_v3")), TerminateIllegalWrapper)
    wrappers = [{"frame_stack_v1": {"stack_size": 2}}]
    env = stock_stepping(EnvironmentConfig.model_validate({"entry_point": COUNTING, "wrappers": wrappers}), num_envs=1)
    assert begin(env, [0]).batches[0].observations["observation"].shape == (1, 6)


def test_a_crash_affects_its_own_episode_only(caplog: pytest.LogCaptureFixture) -> None:
    for crashes, seeds, num_envs, crashed in (([1], 3, 2, [1]), ([0, 2, 4], 6, 1, [0, 0, 0])):
        env = stock_stepping(config(crashes=crashes), num_envs, crashes=1)  # only consecutive ones are limited
        turns = list(turns_until_the_end(env, begin(env, list(range(seeds)))))
        assert [env_index for turn in turns for env_index in turn.crashed.tolist()] == crashed
        assert sum(len(turn.finished) for turn in turns) == seeds - len(crashes)
        assert sum(len(list(turn.each_ending())) for turn in turns) == 2 * (seeds - len(crashes))
    env = stock_stepping(config(crashes=list(range(10))), 1, crashes=2)
    with pytest.raises(RuntimeError, match="simulator is gone"):
        list(turns_until_the_end(env, env.start(each_agent_alone(itertools.count(), 2))))
    assert "seed 1 and is recreated (2 of 2 consecutive times): RuntimeError: the simulator" in caplog.messages[-1]


def test_the_last_observation_survives_the_next_reset() -> None:
    env = stock_stepping(of_class(ReusedArrays, truncated=[0, 1]), 1)
    turn = next(turn for turn in turns_until_the_end(env, begin(env, [5, 6])) if turn.endings)
    assert turn.batches, "the next episode has begun"
    assert [ending.observation["observation"].tolist() for ending in turn.each_ending()] == [[0, 3, 5], [1, 3, 5]]


def test_a_reward_that_is_not_finite_is_rejected_despite_a_crash_budget() -> None:
    for value in (float("nan"), float("inf")):
        env = stock_stepping(config(bad_reward=value), 1, crashes=3)
        turn = begin(env, [12])
        with pytest.raises(InvalidReward, match=rf"agent_0 got a reward of {value} in the episode with seed 12"):
            env.step(zeros(turn))


def test_an_environment_is_rendered() -> None:
    blind, env = (
        stock_stepping(EnvironmentConfig(entry_point="mpe2.simple_spread_v3"), 1, render_mode=mode)
        for mode in (None, "rgb_array")
    )
    begin(blind, [0])
    with pytest.raises(EnvironmentMismatch, match="cannot be rendered"):
        blind.render(0)
    begin(env, [0])
    image = env.render(0)
    assert (image.dtype, image.ndim, image.shape[2]) == (np.uint8, 3, 3)
    env.close()


def test_agents_terminate_once_and_an_episode_without_agents_is_over() -> None:
    env = stock_stepping(of_class(RepeatedTermination), 1)
    turns = list(turns_until_the_end(env, begin(env, [0])))
    endings = [(ending.agent, ending.reward) for turn in turns for ending in turn.each_ending()]
    assert sorted(endings) == [(0, 1.0), (1, 1.0)]
    env = stock_stepping(of_class(NoAllFlag), 1)
    turns = list(turns_until_the_end(env, begin(env, [0])))
    assert [env_index for turn in turns for env_index in turn.finished.tolist()] == [0]


def test_without_a_state_or_a_request_there_are_none() -> None:
    for make, states in ((tictactoe_v3.env, True), (state_in_info, False)):
        assert all(pair == ({}, {}) for pair in turns_of(make, 4, states))
    env = stock_stepping(EnvironmentConfig(entry_point=f"{CLASSIC}rps_v2"), 2, states=True)
    turn = begin(env, [0, 1])
    assert (turn.states, turn.last_states) == (None, None)
    env.close()


def zeros(turn: Turn) -> dict[Any, np.ndarray]:
    return {group: np.zeros(len(batch), np.int64) for group, batch in turn.batches.items()}


def begin(env: BatchedEnvironment, seeds: list[int]) -> Turn:
    return env.start(each_agent_alone(seeds, len(env.agents)))


@settings(max_examples=25, deadline=None)
@given(st.data())
def test_agents_join_and_leave(data: st.DataObject) -> None:
    n = data.draw(st.integers(1, 4))
    leaves = data.draw(st.lists(st.integers(1, 6), min_size=n, max_size=n))
    # The first agent stays to the end, so that an agent is present at every step.
    leaves[0] = max(leaves)
    arrives = [0] + [data.draw(st.integers(0, leave - 1)) for leave in leaves[1:]]
    truncated = sorted(data.draw(st.sets(st.integers(0, n - 1))))
    kwargs: dict[str, Any] = {"arrives": arrives, "leaves": leaves, "truncated": truncated}
    assert_stepping_conforms(
        lambda n: stock_stepping(config(**kwargs), n), lambda: meeting(**kwargs), [3, 4, 5, 6], num_envs=2
    )


class ReusedArrays(Simultaneous):
    """Writes all observations of an agent into one array."""

    def _observe(self, agent: str) -> np.ndarray:
        arrays = self.__dict__.setdefault("arrays", {})
        array = arrays.setdefault(agent, np.zeros(3, np.float32))
        array[:] = super()._observe(agent)
        return array


class RepeatedTermination(RLlibSimultaneous):
    """Reports the termination of an agent repeatedly, each time with an observation."""

    def step(self, actions: dict[str, int]) -> tuple[dict, ...]:
        self.time += 1
        observations = {agent: self._observe().copy() for agent in self.possible_agents}
        over = {"agent_0": True, "agent_1": False, "__all__": self.time == self.ends}
        return observations, {"agent_0": 1.0, "agent_1": 1.0}, over, {"__all__": False}, {}


class NoAllFlag(RLlibSimultaneous):
    """All agents leave one by one, and the flag `__all__` is never set."""

    def step(self, actions: dict[str, int]) -> tuple[dict, ...]:
        self.time += 1
        assert self.time <= 2, "step without agents"
        agent = f"agent_{self.time - 1}"
        return {"agent_1": self._observe()}, {}, {agent: True, "__all__": False}, {"__all__": False}, {}


LENGTH = 3


class StateInInfo(MultiAgentEnv):
    """Two agents for LENGTH steps. The state is (steps, seed), in the info of the second agent."""

    def __init__(self) -> None:
        super().__init__()
        self.possible_agents = self.agents = ["a", "b"]
        self.observation_spaces = dict.fromkeys(self.agents, gymnasium.spaces.Box(0, 99, (1,), np.float32))
        self.action_spaces = dict.fromkeys(self.agents, gymnasium.spaces.Discrete(2))

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        self._steps, self._seed = 0, seed
        return self._observations(), self._infos()

    def step(self, actions: dict[str, int]) -> Any:
        self._steps += 1
        over = {"__all__": self._steps == LENGTH}
        return self._observations(), dict.fromkeys(actions, 0.0), {"__all__": False}, over, self._infos()

    def _observations(self) -> dict[str, Any]:
        return {agent: np.zeros(1, np.float32) for agent in self.agents}

    def _infos(self) -> dict[str, Any]:
        return {"a": {}, "b": {"state": [[self._steps], [self._seed]]}}


def state_in_info() -> RLlibEnv:
    return RLlibEnv(StateInInfo())


class WithState(Simultaneous):
    def action_space(self, agent: str) -> gymnasium.Space:
        return gymnasium.spaces.Discrete(2)

    def state(self) -> np.ndarray:
        return np.array([[self.time], [self.seed]])


def turns_of(make: Callable[[], Any], steps: int, states: bool = True) -> list[tuple[dict[int, Any], dict[int, Any]]]:
    """States and last states of each turn of one environment, whose episodes have the seeds 1, 2, …"""
    lockstep = Lockstep(StockCopies(make, 1), states)
    turn = lockstep.start(episodes(range(1, 99), [0] * len(lockstep.agents)))
    turns = [turn]
    for _ in range(steps):
        legal = turn.batches[0].observations.get("action_mask")
        rows = len(turn.batches[0])
        turn = lockstep.step({0: np.zeros(rows, np.int64) if legal is None else legal.argmax(axis=1)})
        turns.append(turn)
    lockstep.close()
    return [(states_of(turn.states), states_of(turn.last_states)) for turn in turns]


@pytest.mark.parametrize("make", [state_in_info, WithState])
def test_each_turn_has_the_state_of_its_steps_and_the_last_state_of_an_episode(make: Callable[[], Any]) -> None:
    """RLlib's environments report it in an info."""
    turns = turns_of(make, LENGTH)
    assert [states[0].tolist() for states, _ in turns] == [[0, 1], [1, 1], [2, 1], [0, 2]]
    assert [{env: last.tolist() for env, last in lasts.items()} for _, lasts in turns] == [{}, {}, {}, {0: [3, 1]}]
    assert turns[0][0][0].dtype == np.float32


STEPS = 13


CLASSIC, BUTTERFLY, SISL = "pettingzoo.classic.", "pettingzoo.butterfly.", "pettingzoo.sisl."


SUPPORT, TWO_STEP = "tests.support.environments.", "policy_league.examples.two_step:"


MEETING, COUNTING = f"{SUPPORT}simultaneous:meeting", f"{SUPPORT}counting:counting"


JOINING = {"arrives": [0, 2, 1, 0], "leaves": [4, 5, 2, 3], "truncated": [1, 2]}


LOOPS: list[tuple[str, dict[str, Any]]] = [
    ("mpe2.simple_spread_v3:parallel_env", {}),
    ("mpe2.simple_world_comm_v3:parallel_env", {"continuous_actions": True}),
    (f"{CLASSIC}rps_v2:parallel_env", {"max_cycles": 6}),
    (f"{BUTTERFLY}knights_archers_zombies_v11:parallel_env", {"max_cycles": 60, "spawn_delay": 2}),
    (f"{SISL}multiwalker_v9:parallel_env", {"max_cycles": 40}),
    (f"{CLASSIC}connect_four_v3:env", {}),
    (f"{CLASSIC}leduc_holdem_v4:env", {}),
    (f"{CLASSIC}texas_holdem_no_limit_v6:env", {"num_players": 3}),
    (f"{CLASSIC}tictactoe_v3:env", {}),
    (COUNTING, {"lives": [3, 3]}),
    (COUNTING, {"lives": [3, 3], "truncated": [0, 1]}),
    (COUNTING, {"lives": [1, 4, 2, 4], "truncated": [1, 2]}),
    (MEETING, JOINING),
    (f"{SUPPORT}simultaneous:rllib_meeting", {"ends": 4}),
    (f"{SUPPORT}simultaneous:rllib_meeting", {"truncated": False}),
    (f"{SUPPORT}simultaneous:rllib_meeting", {"silent": True}),
    ("policy_league.examples.traffic:crossing", {}),
    (f"{TWO_STEP}parallel_env", {}),
    (f"{SUPPORT}rllib_two_step:multi_agent_env", {}),
]
"""Functions that create environments, with their arguments."""


def unmodified(entry_point: str, **kwargs: Any) -> tuple[EnvironmentConfig, Callable[[], Any]]:
    """An environment's configuration, and a function that creates the unmodified one."""
    module, _, name = entry_point.partition(":")
    make = getattr(importlib.import_module(module), name)
    module = module if module.startswith(("pettingzoo", "mpe2")) else entry_point
    return EnvironmentConfig(entry_point=module, kwargs=kwargs), lambda: make(**kwargs)


@pytest.mark.parametrize("num_envs", [pytest.param(1, marks=pytest.mark.slow), 3])
@pytest.mark.parametrize("loop", LOOPS, ids=str)
def test_lockstep_equals_the_plain_loop(loop: tuple[str, dict[str, Any]], num_envs: int) -> None:
    config, stock = unmodified(loop[0], **loop[1])
    assert_stepping_conforms(lambda n: stock_stepping(config, n), stock, list(range(100, 105)), num_envs)


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.entry_point)
def test_an_episode_depends_on_its_seed_only(case: Case) -> None:
    config = case.league().environment
    env = build(config)
    spaces = {agent: env.action_space(agent) for agent in env.possible_agents}
    envs = stock_stepping(config, 2)
    first = lockstep(envs, spaces, [3, 4], STEPS)
    again = lockstep(envs, spaces, [4, 3], STEPS)
    elsewhere = lockstep(stock_stepping(config, 1), spaces, [3], STEPS)
    for seed, episode in again.items():
        assert_same_episode(episode, first[seed])
    assert_same_episode(elsewhere[3], first[3])
    observed = {agent: {tuple(map(bytes, report[1].values())) for report in first[3][agent]} for agent in first[3]}
    assert any(len(observations) > 1 for observations in observed.values()), "no observation changes"
