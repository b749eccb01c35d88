"""Vectorised environments for tests: loops over copies of small stock environments, and a game of chance."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from league.config.environment import EnvironmentConfig
from league.environments.adapters import Report, adapter_for, splitter
from league.environments.building import build
from league.environments.vector.tictactoe import TicTacToe
from league.environments.vector.vector_env import AgentRows, VectorEnv
from league.spaces import inputs
from league.spaces.conversion import from_gymnasium


class VectorCopies(VectorEnv):
    """Copies of `entry_point`."""

    entry_point: str

    def __init__(self, num_envs: int, **kwargs: Any) -> None:
        self._create(EnvironmentConfig(entry_point=self.entry_point, kwargs=kwargs), num_envs)

    def _create(self, config: EnvironmentConfig, num_envs: int) -> None:
        envs = [build(config) for _ in range(num_envs)]
        self.num_envs, self.possible_agents = num_envs, tuple(envs[0].possible_agents)
        spaces = [from_gymnasium(envs[0].observation_space(agent)) for agent in self.possible_agents]
        self._inputs = [inputs(space) for space in spaces]
        self._copies = [adapter_for(env, [splitter(space) for space in spaces]) for env in envs]
        self._acting: list[list[int]] = [[] for _ in envs]

    def reset(self, env_ids: NDArray[np.int64], seeds: NDArray[np.int64]) -> Sequence[AgentRows]:
        starting = zip(env_ids.tolist(), seeds.tolist(), strict=True)
        return self._rows({env: self._copies[env].reset(seed) for env, seed in starting})

    def step(self, env_ids: NDArray[np.int64], actions: NDArray[Any]) -> Sequence[AgentRows]:
        coming = iter(actions.tolist() if actions.ndim == 1 else list(actions))
        reports = {}
        for env in env_ids.tolist():
            reports[env] = self._copies[env].step([(agent, next(coming)) for agent in sorted(self._acting[env])])
        assert next(coming, None) is None, "more actions than agents"
        return self._rows(reports)

    def state(self, env_ids: NDArray[np.int64]) -> NDArray[np.float32] | None:
        states = [self._copies[env].state() for env in env_ids.tolist()]
        return None if states[0] is None else np.array([np.ravel(state) for state in states], np.float32)

    def _rows(self, reports: dict[int, list[Report]]) -> Sequence[AgentRows]:
        for env, of_env in reports.items():
            self._acting[env] = [report[0] for report in of_env if not (report[3] or report[4])]
        every = [(env, report) for env, of_env in reports.items() for report in of_env]
        kinds = {str(kind): kind for kind in self._inputs}
        return [
            self._block([(env, report) for env, report in every if str(self._inputs[report[0]]) == kind])
            for kind in kinds
        ]

    def _block(self, rows: Iterable[tuple[int, Report]]) -> AgentRows:
        rows = list(rows)
        observed = self._inputs[rows[0][1][0]] if rows else {}
        return AgentRows(
            np.array([env for env, _ in rows], np.int64),
            np.array([report[0] for _, report in rows], np.int64),
            {name: np.array([report[1][name] for _, report in rows], leaf.dtype) for name, leaf in observed.items()},
            np.array([report[2] for _, report in rows], np.float64),
            np.array([report[3] for _, report in rows], bool),
            np.array([report[4] for _, report in rows], bool),
        )


class Looped(VectorCopies):
    """Copies of any environment."""

    def __init__(self, config: EnvironmentConfig, num_envs: int) -> None:
        self._create(config, num_envs)


class VectorMeeting(VectorCopies):
    entry_point = "tests.support.environments.simultaneous:meeting"


class VectorCounting(VectorCopies):
    entry_point = "tests.support.environments.counting:counting"


class VectorFuse(VectorCopies):
    entry_point = "tests.support.environments.fuses:fuse"


class Faulty(VectorMeeting):
    """Raises in its third step, which the stock environment does not."""

    _steps = 0

    def step(self, env_ids: NDArray[np.int64], actions: NDArray[Any]) -> Sequence[AgentRows]:
        self._steps += 1
        if self._steps == 3:
            raise ArithmeticError("the array is on fire")
        return super().step(env_ids, actions)


class Chance(TicTacToe):
    """The seed decides which player's win counts after the fourth move."""

    def reset(self, env_ids: NDArray[np.int64], seeds: NDArray[np.int64]) -> Sequence[AgentRows]:
        self._seeds = getattr(self, "_seeds", np.zeros(self.num_envs, dtype=np.int64))
        self._seeds[env_ids] = seeds
        return super().reset(env_ids, seeds)

    def step(self, env_ids: NDArray[np.int64], actions: NDArray[Any]) -> Sequence[AgentRows]:
        (rows,) = super().step(env_ids, actions)
        rows.rewards[:] *= np.where(self._seeds[rows.envs] % 2 == 0, 1, -1)
        return (rows,)
