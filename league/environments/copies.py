"""Copies of an environment that are stepped together: stock environments, or one vectorised environment."""

import logging
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing
from functools import partial
from operator import itemgetter
from time import perf_counter
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from league.config.environment import EnvironmentConfig
from league.environments.adapters import EnvAdapter, Report, adapter_for, splitter
from league.environments.building import agent_interface, build
from league.environments.stepping import Batch, Indices, no_envs
from league.environments.vector.columns import agent_rows
from league.environments.vector.vector_env import AgentRows, VectorEnv
from league.errors import EnvironmentMismatch, InvalidReturn, LeagueError, no_exit, one_line
from league.interface import AgentInterface
from league.spaces import inputs
from league.spaces.arrays import environment_actions

logger = logging.getLogger(__name__)

Argument = TypeVar("Argument")
NOBODY = no_envs()


class Copies(ABC):
    """n copies of an environment, and for how long they have worked.

    Attributes:
        agents: Names of the agents.
        actions: Action space of each agent.
        inputs: ONNX inputs of each agent.
        seeds: Seed of the newest episode of each copy, (n,).
        seconds: Execution time of each copy in this episode, (n,).
        crashes: Exceptions of each copy since it has last finished an episode, (n,).
        busy: The copies that are executing, or those that raised in the last call.
        since: When these began.
    """

    def __init__(self, interfaces: Mapping[str, AgentInterface], num_envs: int) -> None:
        self.agents = tuple(interfaces)
        self.actions = [spaces.action for spaces in interfaces.values()]
        self.inputs = [inputs(spaces.observation) for spaces in interfaces.values()]
        self.first_alike = [self.inputs.index(leaves) for leaves in self.inputs]
        """The first agent with the same observations, of each agent."""
        self.seeds, self.crashes = np.zeros(num_envs, np.int64), np.zeros(num_envs, np.int64)
        self.seconds, self.since = np.zeros(num_envs), 0.0
        self.busy = NOBODY

    @abstractmethod
    def reset(self, envs: Indices) -> Sequence[AgentRows]:
        """Start the episodes with `seeds`. See `VectorEnv.reset`."""

    @abstractmethod
    def step(
        self, envs: Indices, batches: Mapping[int, Batch], actions: Mapping[int, NDArray]
    ) -> tuple[Sequence[AgentRows], Indices]:
        """Step copies. Return their rows, see `VectorEnv.step`, and those that raised an exception."""

    @abstractmethod
    def states(self, envs: Indices) -> NDArray[np.float32] | None:
        """Return global states, (m, size); None if the environment has none."""

    @abstractmethod
    def render(self, env: int, agent: str | None) -> Any:
        """Return what `render`, or `render_for` of an agent, returns."""

    @abstractmethod
    def close(self) -> None:
        """Close the copies. What they raise is logged."""


class VectorCopies(Copies):
    """Copies in one vectorised environment."""

    def __init__(
        self, config: EnvironmentConfig, make: Callable[[int], VectorEnv], num_envs: int, fast_seeds: bool = False
    ) -> None:
        """make: number of copies → vectorised environment. fast_seeds: see VectorEnv.use_fast_seeds.

        Raises EnvironmentMismatch if it has other agents than the stock environment.
        """
        with closing(build(config)) as stock:
            super().__init__({agent: agent_interface(stock, agent) for agent in stock.possible_agents}, num_envs)
        self._vector = make(num_envs)
        if fast_seeds:
            self._vector.use_fast_seeds()
        if self._vector.possible_agents != self.agents:
            raise EnvironmentMismatch(
                f"the vectorised environment has agents {', '.join(self._vector.possible_agents)}, the stock"
                f" environment {', '.join(self.agents)}"
            )

    def reset(self, envs: Indices) -> Sequence[AgentRows]:
        return self._call(envs, partial(self._vector.reset, envs, self.seeds[envs]))

    def step(
        self, envs: Indices, batches: Mapping[int, Batch], actions: Mapping[int, NDArray]
    ) -> tuple[Sequence[AgentRows], Indices]:
        every_action = [actions[group] for group in batches]
        joined = every_action[0]
        if len(batches) > 1:
            keys = [[getattr(batch, key) for batch in batches.values()] for key in ("agents", "envs")]
            joined = np.concatenate(every_action)[np.lexsort([np.concatenate(key) for key in keys])]
        return self._call(envs, partial(self._vector.step, envs, joined)), NOBODY

    def states(self, envs: Indices) -> NDArray[np.float32] | None:
        return self._vector.state(envs)

    def render(self, env: int, agent: str | None) -> Any:  # noqa: ARG002
        raise EnvironmentMismatch("a vectorised environment cannot be rendered")

    def close(self) -> None:
        """Do nothing: the stock environment is closed already."""

    def _call(self, envs: Indices, call: Callable[[], Sequence[AgentRows]]) -> Sequence[AgentRows]:
        self.since, self.busy = perf_counter(), envs
        try:
            with no_exit:
                rows = call()
        except Exception as error:
            seeds = ", ".join(map(str, self.seeds[envs[:8]]))
            error.add_note(f"in one of {len(envs)} episodes, with the seeds {seeds}{', …' * (len(envs) > 8)}")
            raise
        self.busy = NOBODY
        self.seconds[envs] += (perf_counter() - self.since) / len(envs)
        return rows


class StockCopies(Copies):
    """Environments of any API, stepped one after the other. One that raises is recreated.

    Episodes of an environment differ only by their seeds. PettingZoo requires `reset` to clear all other state.
    """

    def __init__(
        self,
        make: Callable[[], Any],
        num_envs: int,
        most_crashes: int = 0,
        make_of_seed: Callable[[int], Any] | None = None,
    ) -> None:
        """most_crashes: consecutive exceptions after which an environment is recreated; the next one is raised.
        make_of_seed: makes the environment of each episode from its seed; by default all are alike."""
        with ExitStack() as created:
            envs = [created.enter_context(closing(make())) for _ in range(num_envs)]
            interfaces = {agent: agent_interface(envs[0], agent) for agent in envs[0].possible_agents}
            super().__init__(interfaces, num_envs)
            self._splits = [splitter(spaces.observation) for spaces in interfaces.values()]
            self._rows = partial(agent_rows, self.agents, self.inputs, self.first_alike)
            self._envs: list[EnvAdapter] = [adapter_for(env, self._splits) for env in envs]
            created.pop_all()
        self._make, self._make_of_seed, self._most_crashes = make, make_of_seed, most_crashes
        self._alone = list(np.arange(num_envs)[:, np.newaxis])

    def reset(self, envs: Indices) -> Sequence[AgentRows]:
        started = {}
        for env in envs.tolist():
            while (reports := self._call(env, self._reset, env)) is None:
                pass
            started[env] = reports
        return self._rows(started)

    def step(
        self, envs: Indices, batches: Mapping[int, Batch], actions: Mapping[int, NDArray]
    ) -> tuple[Sequence[AgentRows], Indices]:
        moves: dict[int, list[tuple[int, Any]]] = {env: [] for env in envs.tolist()}
        for group, batch in batches.items():
            group_actions = environment_actions(actions[group], self.actions[batch.agents[0]])
            for env, agent, action in zip(batch.envs.tolist(), batch.agents.tolist(), group_actions, strict=True):
                moves[env].append((agent, action))
        # The order of actions must not depend on the grouping of agents.
        reports = {
            env: self._call(env, self._envs[env].step, sorted(acting, key=itemgetter(0)))
            for env, acting in moves.items()
        }
        crashed = [env for env, env_reports in reports.items() if env_reports is None]
        return self._rows(reports), np.array(crashed, dtype=np.int64) if crashed else NOBODY

    def states(self, envs: Indices) -> NDArray[np.float32] | None:
        values = [self._envs[env].state() for env in envs]
        if any(value is None for value in values):
            return None
        return np.array([np.ravel(value) for value in values], dtype=np.float32)

    def render(self, env: int, agent: str | None) -> Any:
        with no_exit:
            return self._envs[env].render(agent)

    def close(self) -> None:
        # The one that was interrupted may hang again.
        for env in sorted(range(len(self._envs)), key=self.busy.tolist().count):
            self._envs[env].close()

    def _reset(self, env: int) -> list[Report]:
        seed = int(self.seeds[env])
        if self._make_of_seed is not None:
            self._envs[env].close()
            self._envs[env] = adapter_for(self._make_of_seed(seed), self._splits)
        return self._envs[env].reset(seed)

    def _call(self, env: int, call: Callable[[Argument], list[Report]], argument: Argument) -> list[Report] | None:
        """Return the reports of a call; None if it raised, and the environment was recreated."""
        self.since, self.busy = perf_counter(), self._alone[env]
        try:
            with no_exit:
                reports = call(argument)
        except InvalidReturn as error:
            raise InvalidReturn(f"{error}, in the episode with seed {self.seeds[env]}") from error
        except LeagueError:
            raise
        except Exception as error:
            self._crash(env, error)
            return None
        self.busy = NOBODY
        self.seconds[env] += perf_counter() - self.since
        return reports

    def _crash(self, env: int, error: Exception) -> None:
        """Recreate an environment, or raise the error after too many crashes."""
        self.crashes[env] += 1
        if self.crashes[env] > self._most_crashes:
            error.add_note(f"in the episode with seed {self.seeds[env]}")
            raise error
        logger.warning(
            "The environment raised in the episode with seed %d and is recreated (%d of %d consecutive times): %s",
            self.seeds[env],
            self.crashes[env],
            self._most_crashes,
            one_line(error, with_type=True),
        )
        self.busy = NOBODY
        self._envs[env].close()
        self._envs[env] = adapter_for(self._make(), self._splits)
