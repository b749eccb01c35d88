"""A VectorEnv of any stock environment: a loop over its adapters."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from league.config.environment import EnvironmentConfig
from league.environments.adapters import Report, adapter_for
from league.environments.building import build, observation_space
from league.environments.vector.vector_env import AgentRows, VectorEnv
from league.spaces.arrays import tensors
from league.spaces.conversion import from_gymnasium


class Looped(VectorEnv):
    """Slow but general, to test what is above vectorised environments."""

    def __init__(self, config: EnvironmentConfig, num_envs: int) -> None:
        self.num_envs = num_envs
        envs = [build(config) for _ in range(num_envs)]
        self.possible_agents = tuple(envs[0].possible_agents)
        self._spaces = [from_gymnasium(observation_space(envs[0], agent)) for agent in self.possible_agents]
        splits = [lambda value, space=space: tensors(space, value) for space in self._spaces]
        self._envs = [adapter_for(env, splits) for env in envs]
        self._acting: list[list[int]] = [[] for _ in envs]

    def reset(self, env_ids: NDArray[np.int64], seeds: NDArray[np.int64]) -> Sequence[AgentRows]:
        return self._blocks(
            [
                (env, report)
                for env, seed in zip(env_ids.tolist(), seeds.tolist(), strict=True)
                for report in self._envs[env].reset(seed)
            ]
        )

    def step(self, env_ids: NDArray[np.int64], actions: NDArray[Any]) -> Sequence[AgentRows]:
        plain = iter(actions.tolist() if actions.ndim == 1 else list(actions))
        reports = []
        for env in env_ids.tolist():
            moves = [(agent, next(plain)) for agent in sorted(self._acting[env])]
            reports += [(env, report) for report in self._envs[env].step(moves)]
        return self._blocks(reports)

    def state(self, env_ids: NDArray[np.int64]) -> NDArray[np.float32] | None:
        states = [self._envs[env].state() for env in env_ids.tolist()]
        return None if states[0] is None else np.array([np.ravel(state) for state in states], dtype=np.float32)

    def _blocks(self, reports: list[tuple[int, Report]]) -> list[AgentRows]:
        for env in {env for env, _ in reports}:
            of_env = (report for item, report in reports if item == env)
            self._acting[env] = [
                agent for agent, _, _, terminated, truncated in of_env if not (terminated or truncated)
            ]
        spaces = list({str(space): space for space in self._spaces}.values())
        return [self._rows([(env, item) for env, item in reports if self._spaces[item[0]] == one]) for one in spaces]

    @staticmethod
    def _rows(reports: list[tuple[int, Report]]) -> AgentRows:
        names = reports[0][1][1] if reports else ()
        return AgentRows(
            envs=np.array([env for env, _ in reports], dtype=np.int64),
            agents=np.array([report[0] for _, report in reports], dtype=np.int64),
            observations={name: np.array([report[1][name] for _, report in reports]) for name in names},
            rewards=np.array([report[2] for _, report in reports], dtype=np.float64),
            terminations=np.array([report[3] for _, report in reports], dtype=bool),
            truncations=np.array([report[4] for _, report in reports], dtype=bool),
        )
