"""Global states: which step they belong to, and that the last state of an episode is not the first of the next."""

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
from mpe2 import simple_spread_v3
from pettingzoo.classic import tictactoe_v3
from ray.rllib.env.multi_agent_env import MultiAgentEnv

from league.environments.lockstep import Lockstep
from tests.conformance.stepping import states_of as by_env
from tests.support.environments.episodes import episodes

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


def states_of(make: Callable[[], Any], steps: int, states: bool = True) -> list[tuple[dict[int, Any], dict[int, Any]]]:
    """States and last states of each turn of one environment, whose episodes have the seeds 1, 2, …"""
    lockstep = Lockstep(make, 1, states=states)
    turn = lockstep.start(episodes(range(1, 99), [0] * len(lockstep.agents)))
    found = [(by_env(turn.states), by_env(turn.last_states))]
    for _ in range(steps):
        legal = turn.batches[0].observations.get("action_mask")
        rows = len(turn.batches[0])
        turn = lockstep.step({0: np.zeros(rows, np.int64) if legal is None else legal.argmax(axis=1)})
        found.append((by_env(turn.states), by_env(turn.last_states)))
    lockstep.close()
    return found


def test_rllib_environments_report_the_state_in_an_info() -> None:
    found = states_of(StateInInfo, LENGTH)
    assert [states[0].tolist() for states, _ in found] == [[0, 1], [1, 1], [2, 1], [0, 2]]
    assert [{env_index: last.tolist() for env_index, last in lasts.items()} for _, lasts in found] == [
        {},
        {},
        {},
        {0: [3, 1]},
    ]
    assert found[0][0][0].dtype == np.float32


def test_pettingzoo_environments_have_a_state_method() -> None:
    found = states_of(lambda: simple_spread_v3.parallel_env(max_cycles=LENGTH), LENGTH)
    assert all(states[0].shape == (54,) for states, _ in found)
    assert set(found[-1][1]) == {0}
    assert not np.array_equal(found[-1][1][0], found[-1][0][0])


@pytest.mark.parametrize(
    ("make", "states"), [(tictactoe_v3.env, True), (StateInInfo, False)], ids=["no state", "not requested"]
)
def test_without_a_state_or_a_request_there_are_none(make: Callable[[], Any], states: bool) -> None:
    assert all(pair == ({}, {}) for pair in states_of(make, 4, states))
