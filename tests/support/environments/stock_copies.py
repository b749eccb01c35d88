"""Compares a vectorised AEC environment with stock copies, call by call."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from league.environment_config import EnvironmentConfig
from league.environments.adapters import EnvAdapter, Report, adapter_for
from league.environments.building import build
from league.environments.vector.vector_env import AgentRows, VectorEnv
from league.spaces import ACTION_MASK, OBSERVATION

Columns = Mapping[str, NDArray]


class ComparedEnv:
    """A vectorised environment with one observation space, and stock copies with the same seeds and actions.

    `reset` and `step` raise AssertionError if a report differs.

    Attributes:
        masks: Mask of the agent who must act in each copy, (n, actions); all 0 if the episode is over.
    """

    def __init__(self, config: EnvironmentConfig, vector: VectorEnv) -> None:
        self._vector = vector
        self._stock = [_adapter(config, vector) for _ in range(vector.num_envs)]
        self._previous: list[tuple[Columns, Columns]] = []
        self.masks = np.zeros((vector.num_envs, 0))

    def reset(self, env_ids: NDArray, seeds: NDArray) -> AgentRows:
        """Start episodes in both."""
        (rows,) = self._vector.reset(env_ids, seeds)
        reports = [self._stock[env].reset(int(seed)) for env, seed in zip(env_ids, seeds, strict=True)]
        return self._compared(env_ids, rows, reports)

    def step(self, env_ids: NDArray, actions: NDArray) -> AgentRows:
        """Step both. One agent acts in each copy."""
        (rows,) = self._vector.step(env_ids, actions)
        reports = [self._stock[env].step([(0, int(action))]) for env, action in zip(env_ids, actions, strict=True)]
        return self._compared(env_ids, rows, reports)

    def play(self, seeds: NDArray, actions: list[int]) -> AgentRows:
        """Play the same legal actions in one copy for each seed. Returns the last reports."""
        env_ids = np.arange(len(seeds))
        rows = self.reset(env_ids, seeds)
        for action in actions:
            assert self.masks[env_ids, action].all(), f"action {action} is illegal"
            rows = self.step(env_ids, np.full(len(seeds), action))
        return rows

    def _compared(self, env_ids: NDArray, rows: AgentRows, reports: list[list[Report]]) -> AgentRows:
        found = _columns(rows)
        expected = _stock_columns(env_ids, reports)
        assert found.keys() == expected.keys()
        for name, column in expected.items():
            _assert_equal(name, found[name], column)
        for before, copied in self._previous:
            for name, column in copied.items():
                assert before[name].tobytes() == column.tobytes(), f"{name} of an earlier call has changed"
        self._previous = [*self._previous[-2:], (found, {name: column.copy() for name, column in found.items()})]
        self._update_masks(env_ids, rows)
        return rows

    def _update_masks(self, env_ids: NDArray, rows: AgentRows) -> None:
        masks = rows.observations[ACTION_MASK]
        if not self.masks.size:
            self.masks = np.zeros((self._vector.num_envs, masks.shape[1]))
        self.masks[env_ids] = 0
        acting = ~(rows.terminations | rows.truncations)
        self.masks[rows.envs[acting]] = masks[acting]


def _adapter(config: EnvironmentConfig, vector: VectorEnv) -> EnvAdapter:
    env = build(config)
    assert tuple(env.possible_agents) == vector.possible_agents
    return adapter_for(env, [lambda value: {OBSERVATION: value[OBSERVATION], ACTION_MASK: value[ACTION_MASK]}] * 2)


def _columns(rows: AgentRows) -> Columns:
    return {
        "envs": rows.envs,
        "agents": rows.agents,
        "rewards": rows.rewards,
        "terminations": rows.terminations,
        "truncations": rows.truncations,
        **rows.observations,
    }


def _stock_columns(env_ids: NDArray, reports: list[list[Report]]) -> Columns:
    flat = [report for of_copy in reports for report in of_copy]
    agents, observations, rewards, terminations, truncations = zip(*flat, strict=True)
    return {
        "envs": np.repeat(env_ids, [len(of_copy) for of_copy in reports]),
        "agents": np.array(agents),
        "rewards": np.array(rewards, dtype=np.float64),
        "terminations": np.array(terminations),
        "truncations": np.array(truncations),
        **{name: np.array([observation[name] for observation in observations]) for name in observations[0]},
    }


def _assert_equal(name: str, found: NDArray, expected: NDArray) -> None:
    assert found.dtype == expected.dtype, f"{name} is {found.dtype}, not {expected.dtype}"
    assert found.shape == expected.shape, f"{name} is {found.shape}, not {expected.shape}"
    assert found.tobytes() == expected.tobytes(), f"{name}:\n{found}\nexpected:\n{expected}"
