"""Steps a vectorised environment, with the results of its stock environment in lockstep."""

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from functools import partial
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from league.config.environment import EnvironmentConfig
from league.environments.building import agent_interface, build
from league.environments.episode_replay import EpisodeActions, StepActions
from league.environments.stepping import (
    Batch,
    EpisodeStepping,
    Indices,
    NextEpisodes,
    States,
    Turn,
    check_actions,
    invalid_reward,
    no_envs,
    picture,
    without_action,
)
from league.environments.vector.vector_env import AgentRows, VectorEnv
from league.errors import EnvironmentMismatch, LeagueError, no_exit, one_line
from league.spaces import inputs


class VectorStepping(EpisodeStepping):
    """Implements BatchedEnvironment by a vectorised environment.

    If the vectorised environment raises, the episodes in progress are replayed in stock environments. Those that raise
    there have crashed, as in lockstep. All others are replayed in a new vectorised environment, and play continues.
    Episodes with fast seeds cannot be replayed: then the environment's first exception is reported as a fault.
    """

    def __init__(
        self,
        config: EnvironmentConfig,
        make: Callable[[int], VectorEnv],
        num_envs: int,
        crashes: int = 0,
        states: bool = False,
        fast_seeds: bool = False,
    ) -> None:
        """make: number of copies → vectorised environment. fast_seeds: see VectorEnv.use_fast_seeds.

        Raises EnvironmentMismatch if it has other agents than the stock environment.
        """
        self._config, self._make, self._gives_states, self._has_fast_seeds = config, make, states, fast_seeds
        self._vector = make(num_envs)
        if fast_seeds:
            self._vector.use_fast_seeds()
        with closing(build(config)) as stock:
            super().__init__(stock.possible_agents, num_envs, crashes)
            interfaces = [agent_interface(stock, agent) for agent in self.agents]
        if self._vector.possible_agents != self.agents:
            raise EnvironmentMismatch(
                f"the vectorised environment has agents {', '.join(self._vector.possible_agents)}, the stock"
                f" environment {', '.join(self.agents)}"
            )
        self._actions = [spaces.action for spaces in interfaces]
        observed = [inputs(spaces.observation) for spaces in interfaces]
        self._first_alike = [observed.index(leaves) for leaves in observed]
        self._episodes = EpisodeActions(num_envs)
        self._plays = np.zeros(num_envs, dtype=bool)
        """Which environments have an episode."""
        self._busy = no_envs()

    def start(self, next_episodes: NextEpisodes) -> Turn:
        self._next_episodes = next_episodes
        self._plays[:] = False
        self._abandoned = self._busy = no_envs()
        return self._continue(Turn(), [], np.arange(self.num_envs))

    def step(self, actions: Mapping[int, NDArray]) -> Turn:
        for group, batch in self._pending.items():
            check_actions(batch, actions[group], self._actions[batch.agents[0]], self.agents)
        abandoned, self._abandoned = self._abandoned, no_envs()
        self._plays[abandoned] = False
        rows: Sequence[AgentRows] = []
        crashed = no_envs()
        if self._pending:
            rows, crashed = self._step(_sorted_actions(self._pending, actions))
        finished = np.flatnonzero(self._plays & ~self._acts(rows))
        if len(crashed):
            finished = np.setdiff1d(finished, crashed)
        self._crashes.finish(finished)
        turn = Turn(finished=finished, crashed=crashed, last_states=self._states(finished))
        turn.endings = [block.take(ended) for block in rows if len(ended := np.flatnonzero(block.has_ended))]
        self._plays[finished] = self._plays[crashed] = False
        free = np.concatenate([finished, crashed, abandoned])
        free.sort()
        return self._continue(turn, rows, free)

    @property
    def busy(self) -> Indices:
        return self._busy

    def seconds(self) -> NDArray[np.float64]:
        seconds, busy = self._seconds.copy(), self._busy
        seconds[busy] += perf_counter() - self._since
        return seconds

    def render(self, env: int, agent: str | None = None) -> NDArray:
        if self._has_fast_seeds:
            raise EnvironmentMismatch("the environment cannot be rendered with fast seeds")
        with closing(self._episodes.in_stock(self._config, env, render_mode="rgb_array")) as stock:
            return picture(stock.render(agent))

    def close(self) -> None:
        """Do nothing: stock environments are closed after each use."""

    def _step(self, step: StepActions) -> tuple[Sequence[AgentRows], Indices]:
        """Step all environments that play. Return their rows, and the environments that have crashed."""
        envs, crashed = np.flatnonzero(self._plays), no_envs()
        rows: Sequence[AgentRows] = []
        while len(envs):
            try:
                rows = self._timed(envs, partial(self._vector.step, envs, step.actions))
                break
            except LeagueError:
                raise
            except Exception as error:
                crashed = np.union1d(crashed, self._crash(envs, error, step))
            envs, kept = np.setdiff1d(envs, crashed), ~np.isin(step.envs, crashed)
            step = StepActions(step.envs[kept], step.agents[kept], step.actions[kept])
            self._renew(envs)
        if len(envs):
            self._episodes.add(step)
        self._check_rewards(rows)
        return rows, crashed

    def _reset(self, envs: Indices, seeds: Indices) -> Sequence[AgentRows]:
        """Start episodes."""
        self._episodes.begin(envs, seeds)
        while True:
            try:
                rows = self._timed(envs, partial(self._vector.reset, envs, seeds))
                break
            except LeagueError:
                raise
            except Exception as error:
                self._crash(envs, error)
                self._renew(np.flatnonzero(self._plays))
        self._plays[envs] = self._acts(rows)[envs]
        if len(over := envs[~self._plays[envs]]):
            raise without_action(self._episodes.seed(int(over[0])))
        self._check_rewards(rows)
        return rows

    def _continue(self, turn: Turn, rows: Sequence[AgentRows], free: Indices) -> Turn:
        """Start the next episodes of free environments, and report who must act."""
        if len(free):
            starting, seeds = self._starts(free)
            if len(starting):
                rows = [*rows, *self._reset(starting, seeds)]
        turn.states = self._states(np.flatnonzero(self._plays))
        turn.batches = self._pending = self._batches(rows)
        return turn

    def _timed(self, envs: Indices, call: Callable[[], Sequence[AgentRows]]) -> Sequence[AgentRows]:
        self._since = perf_counter()
        self._busy = envs
        with no_exit:
            rows = call()
        self._busy = no_envs()
        self._seconds[envs] += (perf_counter() - self._since) / len(envs)
        return rows

    def _crash(self, envs: Indices, error: Exception, step: StepActions | None = None) -> Indices:
        """Return the environments whose stock environment raises too, in the given step or in the reset.

        Raises its error after too many crashes of an environment, and EnvironmentMismatch if none raises, or if
        episodes have fast seeds.
        """
        if self._has_fast_seeds:
            raise EnvironmentMismatch(
                f"the vectorised environment raised with fast seeds: {one_line(error, with_type=True)}"
            ) from error
        crashed = []
        for env in envs.tolist():
            self._since, self._busy = perf_counter(), np.array([env])
            try:
                self._episodes.in_stock(self._config, env, step).close()
            except LeagueError:
                raise
            except Exception as stock_error:
                self._crashes.count(env, self._episodes.seed(env), stock_error)
                crashed.append(env)
        self._busy = no_envs()
        if not crashed:
            raise EnvironmentMismatch(
                "the vectorised environment raised, but the stock environment does not:"
                f" {one_line(error, with_type=True)}"
            ) from error
        return np.array(crashed)

    def _renew(self, envs: Indices) -> None:
        """Replace the vectorised environment by a new one in which these environments continue their episodes."""
        self._vector = self._make(self.num_envs)
        self._episodes.in_vector(self._vector, envs)

    def _acts(self, rows: Sequence[AgentRows]) -> NDArray[np.bool_]:
        """Return in which environments an agent must act, (n,)."""
        acts = np.zeros(self.num_envs, dtype=bool)
        for block in rows:
            acts[block.envs[~block.has_ended]] = True
        return acts

    def _check_rewards(self, rows: Sequence[AgentRows]) -> None:
        for block in rows:
            if not (is_finite := np.isfinite(block.rewards)).all():
                row = int(np.argmin(is_finite))
                seed = self._episodes.seed(int(block.envs[row]))
                raise invalid_reward(self.agents[block.agents[row]], block.rewards[row], seed)

    def _batches(self, rows: Sequence[AgentRows]) -> dict[int, Batch]:
        """Return the rows of all agents that must act, by ascending group."""
        alike: dict[int, list[AgentRows]] = defaultdict(list)
        for block in rows:
            if len(block.envs):
                alike[self._first_alike[block.agents[0]]].append(block)
        batches = {}
        for blocks in alike.values():
            batches.update(self._split(blocks))
        return dict(sorted(batches.items()))

    def _split(self, blocks: Sequence[AgentRows]) -> dict[int, Batch]:
        envs, agents = _column(blocks, "envs"), _column(blocks, "agents")
        acting = np.flatnonzero(~np.concatenate([block.has_ended for block in blocks]))
        if len(blocks) > 1:
            acting = acting[np.argsort(envs[acting], kind="stable")]
        groups = self._groups[envs[acting], agents[acting]]
        rewards = _column(blocks, "rewards")
        observations = {
            name: _concatenated([block.observations[name] for block in blocks]) for name in blocks[0].observations
        }
        every_row = Batch(envs, agents, observations, rewards)
        present = np.flatnonzero(np.bincount(groups)).tolist()
        if len(present) > 1:
            return {group: every_row.rows(acting[groups == group]) for group in present}
        is_unchanged = len(blocks) == 1 and len(acting) == len(envs)
        return {group: every_row if is_unchanged else every_row.rows(acting) for group in present}

    def _states(self, envs: Indices) -> States | None:
        if not self._gives_states or not len(envs):
            return None
        values = self._vector.state(envs)
        return None if values is None else States(envs, values)


def _column(blocks: Sequence[AgentRows], name: str) -> NDArray:
    return _concatenated([getattr(block, name) for block in blocks])


def _concatenated(columns: Sequence[NDArray]) -> NDArray:
    return columns[0] if len(columns) == 1 else np.concatenate(columns)


def _sorted_actions(batches: Mapping[int, Batch], actions: Mapping[int, NDArray]) -> StepActions:
    """Return the actions of all groups, sorted by environment, then by agent."""
    if len(batches) == 1:
        ((group, batch),) = batches.items()
        return StepActions(batch.envs, batch.agents, actions[group])
    envs = _concatenated([batch.envs for batch in batches.values()])
    agents = _concatenated([batch.agents for batch in batches.values()])
    joined = _concatenated([actions[group] for group in batches])
    order = np.lexsort((agents, envs))
    return StepActions(envs[order], agents[order], joined[order])
