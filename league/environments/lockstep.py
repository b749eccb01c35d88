"""Steps n environments of any API in lockstep and batches their observations."""

import contextlib
import logging
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from operator import itemgetter
from time import perf_counter
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from league.environment_config import EnvironmentConfig
from league.environments.adapters import EnvAdapter, Observation, Report, adapter_for
from league.environments.building import action_space, build, observation_space
from league.environments.stepping import Batch, BatchedEnvironment, Ending, Group, NextEpisode, Turn, check_actions
from league.errors import EnvironmentMismatch, InvalidReward, LeagueError, ObservationError, one_line
from league.spaces import ACTION_MASK, OBSERVATION, DictSpace, Leaf, Space, inputs
from league.spaces.arrays import tensors
from league.spaces.conversion import from_gymnasium

logger = logging.getLogger(__name__)

Given = TypeVar("Given")

Rows = dict[Group, tuple[list[int], list[int], list[Observation], list[float]]]


def stepping(
    config: EnvironmentConfig,
    num_envs: int,
    *,
    crashes: int = 0,
    render_mode: str | None = None,
    states: bool = False,
) -> BatchedEnvironment:
    """Create environments that are stepped in lockstep.

    Args:
        config: The environment.
        num_envs: Number of environments.
        crashes: Number of consecutive exceptions after which an environment is recreated; the next one is raised.
        render_mode: PettingZoo's render mode (`rgb_array`, `human`).
        states: Include global states in the results.
    """
    return Lockstep(lambda: build(config, render_mode), num_envs, crashes, states)


class Lockstep:
    """Implements BatchedEnvironment by a loop over environments.

    Episodes of an environment differ only by their seeds. PettingZoo requires `reset` to clear all other state.
    """

    def __init__(self, make: Callable[[], Any], num_envs: int, crashes: int = 0, states: bool = False) -> None:
        self._make, self._most_crashes, self._gives_states = make, crashes, states
        envs = [make() for _ in range(num_envs)]
        self.agents: tuple[str, ...] = tuple(envs[0].possible_agents)
        spaces = [from_gymnasium(observation_space(envs[0], agent)) for agent in self.agents]
        self._splits = [_splitter(space) for space in spaces]
        self._inputs = [inputs(space) for space in spaces]
        self._actions = [from_gymnasium(action_space(envs[0], agent)) for agent in self.agents]
        self._envs: list[EnvAdapter] = [adapter_for(env, self._splits) for env in envs]
        self._seeds = [0] * num_envs
        self._crashes = [0] * num_envs
        self._groups: list[Sequence[Group]] = [()] * num_envs
        self._pending: dict[Group, Batch] = {}
        self._abandoned: set[int] = set()
        self._seconds = [0.0] * num_envs
        self._busy: int | None = None
        self._since = 0.0
        self._next_episode: NextEpisode = lambda _: None

    @property
    def num_envs(self) -> int:
        return len(self._envs)

    def start(self, next_episode: NextEpisode) -> Turn:
        self._next_episode = next_episode
        self._abandoned.clear()
        self._busy = None
        turn = Turn()
        rows: Rows = {}
        for env in range(self.num_envs):
            self._restart(env, turn, rows)
        return self._yield(turn, rows)

    def step(self, actions: Mapping[Group, NDArray]) -> Turn:
        moves: dict[int, list[tuple[int, Any]]] = {}
        for group, batch in self._pending.items():
            check_actions(batch, actions[group], self._actions[batch.agents[0]], self.agents)
            for env, agent, action in zip(batch.envs, batch.agents, _plain(actions[group]), strict=True):
                moves.setdefault(env, []).append((agent, action))
        turn = Turn()
        rows: Rows = {}
        abandoned, self._abandoned = self._abandoned, set()
        for env in sorted(moves.keys() | abandoned):
            if env in abandoned:
                self._restart(env, turn, rows)
                continue
            # The order of actions must not depend on the grouping of agents.
            acting = sorted(moves[env], key=itemgetter(0))
            try:
                reports = self._timed(env, self._envs[env].step, acting)
            except LeagueError:
                raise
            except Exception as error:
                self._crash(env, error)
                turn.crashed.append(env)
                self._restart(env, turn, rows)
            else:
                self._sort_reports(env, reports, turn, rows)
        return self._yield(turn, rows)

    def abandon(self, envs: Collection[int]) -> None:
        self._abandoned.update(envs)
        kept = {group: batch.rows(batch.without(envs)) for group, batch in self._pending.items()}
        self._pending = {group: batch for group, batch in kept.items() if batch.envs}

    def assign(self, env: int, groups: Sequence[Group]) -> None:
        self._groups[env] = groups

    @property
    def busy(self) -> int | None:
        return self._busy

    def seconds(self, env: int) -> float:
        return self._seconds[env] + (perf_counter() - self._since if self._busy == env else 0.0)

    def render(self, env: int) -> NDArray:
        picture = self._envs[env].render()
        if picture is None:
            raise EnvironmentMismatch("the environment cannot be rendered: it does not support render_mode 'rgb_array'")
        return np.asarray(picture, dtype=np.uint8)

    def close(self) -> None:
        for env in self._envs:
            env.close()

    def _timed(self, env: int, call: Callable[[Given], list[Report]], given: Given) -> list[Report]:
        self._since = perf_counter()
        self._busy = env
        reports = call(given)
        self._busy = None
        self._seconds[env] += perf_counter() - self._since
        return reports

    def _restart(self, env: int, turn: Turn, rows: Rows) -> None:
        episode = self._next_episode(env)
        if episode is None:
            return
        self._groups[env] = episode.groups
        self._seconds[env] = 0.0
        # Some environments store the seed as a signed 32-bit integer.
        self._seeds[env] = episode.seed % 2**31
        while True:
            try:
                reports = self._timed(env, self._envs[env].reset, self._seeds[env])
                break
            except LeagueError:
                raise
            except Exception as error:
                self._crash(env, error)
        if not any(_must_act(report) for report in reports):
            raise EnvironmentMismatch(f"the episode with seed {self._seeds[env]} ends at its reset, without an action")
        self._sort_reports(env, reports, turn, rows)

    def _sort_reports(self, env: int, reports: Sequence[Report], turn: Turn, rows: Rows) -> None:
        """Sort reports into batches and endings, and start the next episode if this one is over."""
        is_over = True
        for agent, observation, reward, terminated, truncated in reports:
            if not math.isfinite(reward):
                raise InvalidReward(
                    f"agent {self.agents[agent]} got a reward of {reward} in the episode with seed {self._seeds[env]},"
                    " expected a finite number"
                )
            if terminated or truncated:
                turn.endings.append(Ending(env, agent, observation, reward, terminated, truncated))
                continue
            is_over = False
            group = self._groups[env][agent]
            if group not in rows:
                rows[group] = ([], [], [], [])
            envs, agents, observations, rewards = rows[group]
            envs.append(env)
            agents.append(agent)
            observations.append(observation)
            rewards.append(reward)
        if self._gives_states and (state := self._envs[env].state()) is not None:
            known = turn.last_states if is_over else turn.states
            known[env] = np.array(state, dtype=np.float32).ravel()
        if is_over:
            turn.finished.append(env)
            self._crashes[env] = 0
            self._restart(env, turn, rows)

    def _crash(self, env: int, error: Exception) -> None:
        """Recreate an environment, or raise the error after too many crashes."""
        self._crashes[env] += 1
        if self._crashes[env] > self._most_crashes:
            raise error
        logger.warning(
            "The environment raised in the episode with seed %d and is recreated (%d of %d consecutive times): %s",
            self._seeds[env],
            self._crashes[env],
            self._most_crashes,
            one_line(error, with_type=True),
        )
        self._busy = None
        with contextlib.suppress(Exception):
            self._envs[env].close()
        self._envs[env] = adapter_for(self._make(), self._splits)

    def _yield(self, turn: Turn, rows: Rows) -> Turn:
        for group, (envs, agents, observations, rewards) in rows.items():
            turn.batches[group] = Batch(envs, agents, self._stacked(agents, observations), rewards)
        self._pending = turn.batches
        return turn

    def _stacked(self, agents: Sequence[int], observations: Sequence[Observation]) -> dict[str, NDArray]:
        stacked = {}
        for name, leaf in self._inputs[agents[0]].items():
            try:
                stacked[name] = np.array([row[name] for row in observations], dtype=leaf.dtype)
            except ValueError:
                stacked[name] = np.zeros(0)
            if stacked[name].shape != (len(agents), *leaf.shape):
                raise self._misshapen(name, leaf, agents, observations)
        return stacked

    def _misshapen(
        self, name: str, leaf: Leaf, agents: Sequence[int], observations: Sequence[Observation]
    ) -> ObservationError:
        shapes = [np.shape(row[name]) for row in observations]
        row = next((i for i, shape in enumerate(shapes) if shape != leaf.shape), 0)
        return ObservationError(
            f"agent {self.agents[agents[row]]} observes {name} with shape {list(shapes[row])}, but its space has"
            f" {list(leaf.shape)}"
        )


def _must_act(report: Report) -> bool:
    return not (report[3] or report[4])


def _splitter(space: Space) -> Callable[[Any], Observation]:
    """Return a function from observation to named arrays, optimised for common spaces."""
    if not isinstance(space, DictSpace):
        return lambda value: {OBSERVATION: value}
    if set(space.spaces) == {OBSERVATION, ACTION_MASK}:
        plain = not any(isinstance(part, DictSpace) for part in space.spaces.values())
        if plain:
            return lambda value: {OBSERVATION: value[OBSERVATION], ACTION_MASK: value[ACTION_MASK]}
    return lambda value: tensors(space, value)


def _plain(actions: NDArray) -> list[Any]:
    """Discrete actions as Python integers, which environments use as list indices; other actions as arrays."""
    return actions.tolist() if actions.ndim == 1 else list(actions)
