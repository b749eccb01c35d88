"""Steps n environments of any API in lockstep and batches their observations."""

import math
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing
from operator import itemgetter
from time import perf_counter
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from league.config.environment import EnvironmentConfig
from league.environments.adapters import EnvAdapter, Observation, Report, adapter_for, splitter
from league.environments.building import agent_interface, build
from league.environments.external.stepping import ExternalStepping
from league.environments.stepping import (
    Batch,
    BatchedEnvironment,
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
from league.environments.vector.vector_env import AgentRows
from league.errors import InvalidReturn, LeagueError, ObservationError, no_exit
from league.registry.gateways import ForSimulators
from league.spaces import inputs
from league.spaces.arrays import environment_actions

Given = TypeVar("Given")

Reports = dict[int, list[Report]]
"""Environment → its reports."""


def stock_stepping(
    config: EnvironmentConfig,
    num_envs: int,
    *,
    crashes: int = 0,
    render_mode: str | None = None,
    states: bool = False,
    of_seed: Callable[[int], EnvironmentConfig] | None = None,
    simulators: ForSimulators | None = None,
) -> BatchedEnvironment:
    """Create copies of the stock environment that are stepped in lockstep, or by the simulators in which it runs.

    Args:
        config: The environment.
        num_envs: Number of environments.
        crashes: Number of consecutive exceptions after which an environment is recreated; the next one is raised.
        render_mode: PettingZoo's render mode (`rgb_array`, `human`).
        states: Include global states in the results.
        of_seed: The environment of the episode with a seed, with the spaces of `config`: each episode has its own.
        simulators: For what simulators may play. None: somebody watches, for whom they cannot.

    Raises ConfigError if the environment cannot be created, and EnvironmentMismatch if only simulators play the game.
    """
    if config.external is not None:
        env = build(config)
        if simulators is None:
            return env.reset()  # raises an error that says why
        spaces = {agent: agent_interface(env, agent) for agent in env.possible_agents}
        return ExternalStepping(config.external, spaces, num_envs, simulators)
    make_of_seed = None if of_seed is None else lambda seed: build(of_seed(seed), render_mode)
    return Lockstep(lambda: build(config, render_mode), num_envs, crashes, states, make_of_seed)


class Lockstep(EpisodeStepping):
    """Implements BatchedEnvironment by a loop over environments.

    Episodes of an environment differ only by their seeds. PettingZoo requires `reset` to clear all other state.
    """

    def __init__(
        self,
        make: Callable[[], Any],
        num_envs: int,
        crashes: int = 0,
        states: bool = False,
        make_of_seed: Callable[[int], Any] | None = None,
    ) -> None:
        """make_of_seed: makes the environment of each episode from its seed; by default all are alike."""
        self._make, self._make_of_seed, self._gives_states = make, make_of_seed, states
        with ExitStack() as created:
            envs = [created.enter_context(closing(make())) for _ in range(num_envs)]
            super().__init__(envs[0].possible_agents, num_envs, crashes)
            interfaces = [agent_interface(envs[0], agent) for agent in self.agents]
            self._splits = [splitter(spaces.observation) for spaces in interfaces]
            self._inputs = [inputs(spaces.observation) for spaces in interfaces]
            self._first_alike = [self._inputs.index(leaves) for leaves in self._inputs]
            self._actions = [spaces.action for spaces in interfaces]
            self._envs: list[EnvAdapter] = [adapter_for(env, self._splits) for env in envs]
            created.pop_all()
        self._seeds = np.zeros(num_envs, np.int64)
        self._busy: int | None = None

    def start(self, next_episodes: NextEpisodes) -> Turn:
        self._next_episodes = next_episodes
        self._abandoned = no_envs()
        self._busy = None
        return self._continue(Turn(), {}, np.arange(self.num_envs))

    def step(self, actions: Mapping[int, NDArray]) -> Turn:
        moves: dict[int, list[tuple[int, Any]]] = defaultdict(list)
        for group, batch in self._pending.items():
            check_actions(batch, actions[group], self._actions[batch.agents[0]], self.agents)
            group_actions = environment_actions(actions[group], self._actions[batch.agents[0]])
            rows = zip(batch.envs.tolist(), batch.agents.tolist(), group_actions, strict=True)
            for env, agent, action in rows:
                moves[env].append((agent, action))
        reports: Reports = {}
        crashed: list[int] = []
        for env in sorted(moves):
            # The order of actions must not depend on the grouping of agents.
            acting = sorted(moves[env], key=itemgetter(0))
            try:
                reports[env] = self._timed(env, self._envs[env].step, acting)
            except InvalidReturn as error:
                raise self._with_seed(env, error) from error
            except LeagueError:
                raise
            except Exception as error:
                self._crash(env, error)
                crashed.append(env)
            else:
                self._check_rewards(env, reports[env])
        finished = [env for env, env_reports in reports.items() if not any(map(_must_act, env_reports))]
        self._crashes.finish(_envs(finished))
        turn = Turn(finished=_envs(finished), crashed=_envs(crashed), last_states=self._states(finished))
        free = np.union1d(_envs([*finished, *crashed]), self._abandoned)
        self._abandoned = no_envs()
        return self._continue(turn, reports, free)

    @property
    def busy(self) -> Indices:
        busy = self._busy
        return no_envs() if busy is None else _envs([busy])

    def seconds(self) -> NDArray[np.float64]:
        seconds, busy = self._seconds.copy(), self._busy
        if busy is not None:
            seconds[busy] += perf_counter() - self._since
        return seconds

    def render(self, env: int, agent: str | None = None) -> NDArray:
        with no_exit:
            return picture(self._envs[env].render(agent))

    def close(self) -> None:
        # The one that was interrupted may hang again.
        for env in sorted(range(self.num_envs), key=lambda env: env == self._busy):
            self._envs[env].close()

    def _timed(self, env: int, call: Callable[[Given], list[Report]], given: Given) -> list[Report]:
        self._since = perf_counter()
        self._busy = env
        with no_exit:
            reports = call(given)
        self._busy = None
        self._seconds[env] += perf_counter() - self._since
        return reports

    def _continue(self, turn: Turn, reports: Reports, free: Indices) -> Turn:
        """Start the next episodes of free environments, and report what has ended and who must act."""
        endings = [
            (env, report) for env, env_reports in reports.items() for report in env_reports if not _must_act(report)
        ]
        acting = {env: [report for report in env_reports if _must_act(report)] for env, env_reports in reports.items()}
        if len(free):
            starting, seeds = self._starts(free)
            self._seeds[starting] = seeds
            acting |= {env: self._reset(env) for env in starting.tolist()}
        rows = [(env, report) for env in sorted(acting) for report in acting[env]]
        turn.states = self._states(sorted(env for env, env_reports in acting.items() if env_reports))
        blocks: dict[int, list[tuple[int, Report]]] = defaultdict(list)
        for row in endings:
            blocks[self._first_alike[row[1][0]]].append(row)
        turn.endings = [self._block(blocks[first]) for first in sorted(blocks)]
        turn.batches = self._pending = self._batches(rows)
        return turn

    def _reset(self, env: int) -> list[Report]:
        while True:
            try:
                if self._make_of_seed is not None:
                    self._envs[env].close()
                    self._envs[env] = adapter_for(self._make_of_seed(int(self._seeds[env])), self._splits)
                reports = self._timed(env, self._envs[env].reset, int(self._seeds[env]))
                break
            except InvalidReturn as error:
                raise self._with_seed(env, error) from error
            except LeagueError:
                raise
            except Exception as error:
                self._crash(env, error)
        reports = [report for report in reports if _must_act(report)]
        if not reports:
            raise without_action(int(self._seeds[env]))
        self._check_rewards(env, reports)
        return reports

    def _with_seed(self, env: int, error: InvalidReturn) -> InvalidReturn:
        return InvalidReturn(f"{error}, in the episode with seed {self._seeds[env]}")

    def _check_rewards(self, env: int, reports: Sequence[Report]) -> None:
        for agent, _, reward, _, _ in reports:
            if not math.isfinite(reward):
                raise invalid_reward(self.agents[agent], reward, int(self._seeds[env]))

    def _crash(self, env: int, error: Exception) -> None:
        """Recreate an environment, or raise the error after too many crashes."""
        self._crashes.count(env, int(self._seeds[env]), error)
        self._busy = None
        self._envs[env].close()
        self._envs[env] = adapter_for(self._make(), self._splits)

    def _batches(self, rows: Sequence[tuple[int, Report]]) -> dict[int, Batch]:
        if not rows:
            return {}
        envs, agents = _envs([env for env, _ in rows]), _envs([report[0] for _, report in rows])
        groups = self._groups[envs, agents]
        batches = {}
        for group in np.unique(groups).tolist():
            of_group = np.flatnonzero(groups == group)
            reports = [rows[i][1] for i in of_group.tolist()]
            stacked = self._stacked([report[0] for report in reports], [report[1] for report in reports])
            rewards = np.array([report[2] for report in reports], dtype=np.float64)
            batches[group] = Batch(envs[of_group], agents[of_group], stacked, rewards)
        return batches

    def _block(self, rows: Sequence[tuple[int, Report]]) -> AgentRows:
        agents, observations, rewards, terminations, truncations = zip(*(report for _, report in rows), strict=True)
        return AgentRows(
            _envs([env for env, _ in rows]),
            _envs(agents),
            self._stacked(agents, observations),
            np.array(rewards, dtype=np.float64),
            np.array(terminations, dtype=bool),
            np.array(truncations, dtype=bool),
        )

    def _states(self, envs: Sequence[int]) -> States | None:
        if not self._gives_states or not envs:
            return None
        values = [self._envs[env].state() for env in envs]
        if any(value is None for value in values):
            return None
        return States(_envs(envs), np.array([np.ravel(value) for value in values], dtype=np.float32))

    def _stacked(self, agents: Sequence[int], observations: Sequence[Observation]) -> dict[str, NDArray]:
        stacked = {}
        for name, leaf in self._inputs[agents[0]].items():
            try:
                stacked[name] = np.array([row[name] for row in observations], dtype=leaf.dtype)
            except (TypeError, ValueError):
                stacked[name] = np.zeros(0)
            if stacked[name].shape != (len(agents), *leaf.shape):
                shapes = [np.shape(row[name]) for row in observations]
                number = next((i for i, shape in enumerate(shapes) if shape != leaf.shape), 0)
                raise ObservationError(
                    f"agent {self.agents[agents[number]]} observes {name} with shape {list(shapes[number])}, but its"
                    f" space has {list(leaf.shape)}"
                )
        return stacked


def _envs(numbers: Sequence[int]) -> Indices:
    return np.array(numbers, dtype=np.int64)


def _must_act(report: Report) -> bool:
    return not (report[3] or report[4])
