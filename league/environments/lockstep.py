"""n copies of an environment in lockstep, whatever its API: PettingZoo's AEC or Parallel, or RLlib's MultiAgentEnv."""

import contextlib
import logging
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from operator import itemgetter
from time import perf_counter
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from league.config import EnvironmentConfig
from league.environments.building import action_space, build, observation_space
from league.environments.copies import Copy, Observation, Report, copy_of
from league.environments.legality import check_actions
from league.environments.stepping import Batch, BatchedEnvironment, Ending, Group, NextEpisode, Turn
from league.errors import EnvironmentMismatch, InvalidReward, LeagueError, ObservationError
from league.spaces import ACTION_MASK, OBSERVATION, DictSpace, Leaf, Space, from_gymnasium, inputs, tensors

logger = logging.getLogger(__name__)

Given = TypeVar("Given")

Rows = dict[Group, tuple[list[int], list[int], list[Observation], list[float]]]


def stepping(
    config: EnvironmentConfig,
    copies: int,
    *,
    crashes: int = 0,
    render_mode: str | None = None,
    states: bool = False,
) -> BatchedEnvironment:
    """`copies` environments in lockstep.

    crashes: how often in a row a copy may raise and is built anew; beyond, its exception goes to the caller.
    states: give the environment's global states along.
    render_mode: PettingZoo's, for copies that shall be rendered (`rgb_array`, `human`).
    """
    return Lockstep(lambda: build(config, render_mode), copies, crashes, states)


class Lockstep:
    """A loop over copies.

    The episodes of a copy are told apart by their seeds alone: nothing of one reaches the next but the environment
    object itself, which PettingZoo's contract requires `reset` to clear.
    """

    def __init__(self, make: Callable[[], Any], copies: int, crashes: int = 0, states: bool = False) -> None:
        self._make, self._most_crashes, self._gives_states = make, crashes, states
        envs = [make() for _ in range(copies)]
        self.agents: tuple[str, ...] = tuple(envs[0].possible_agents)
        spaces = [from_gymnasium(observation_space(envs[0], agent)) for agent in self.agents]
        self._splits = [_splitter(space) for space in spaces]
        self._inputs = [inputs(space) for space in spaces]
        self._actions = [from_gymnasium(action_space(envs[0], agent)) for agent in self.agents]
        self._copies: list[Copy] = [copy_of(env, self._splits) for env in envs]
        self._seeds = [0] * copies
        self._crashes = [0] * copies
        self._groups: list[Sequence[Group]] = [()] * copies
        self._pending: dict[Group, Batch] = {}
        self._abandoned: set[int] = set()
        self._seconds = [0.0] * copies
        self._busy: int | None = None
        self._since = 0.0
        self._next_episode: NextEpisode = lambda _: None

    @property
    def copies(self) -> int:
        return len(self._copies)

    def start(self, next_episode: NextEpisode) -> Turn:
        self._next_episode = next_episode
        self._abandoned.clear()
        self._busy = None
        turn = Turn()
        rows: Rows = {}
        for copy in range(self.copies):
            self._restart(copy, turn, rows)
        return self._yield(turn, rows)

    def step(self, actions: Mapping[Group, NDArray]) -> Turn:
        moves: dict[int, list[tuple[int, Any]]] = {}
        for group, batch in self._pending.items():
            check_actions(batch, actions[group], self._actions[batch.agents[0]], self.agents)
            for copy, agent, action in zip(batch.copies, batch.agents, _plain(actions[group]), strict=True):
                moves.setdefault(copy, []).append((agent, action))
        turn = Turn()
        rows: Rows = {}
        abandoned, self._abandoned = self._abandoned, set()
        for copy in sorted(moves.keys() | abandoned):
            if copy in abandoned:
                self._restart(copy, turn, rows)
                continue
            # An agent's policy decides which batch it is in, but not when it acts.
            acting = sorted(moves[copy], key=itemgetter(0))
            try:
                reports = self._timed(copy, self._copies[copy].step, acting)
            except LeagueError:
                raise
            except Exception as error:
                self._crash(copy, error)
                turn.crashed.append(copy)
                self._restart(copy, turn, rows)
            else:
                self._take(copy, reports, turn, rows)
        return self._yield(turn, rows)

    def abandon(self, copies: Collection[int]) -> None:
        self._abandoned.update(copies)
        kept = {group: batch.rows(batch.without(copies)) for group, batch in self._pending.items()}
        self._pending = {group: batch for group, batch in kept.items() if batch.copies}

    def assign(self, copy: int, groups: Sequence[Group]) -> None:
        self._groups[copy] = groups

    @property
    def busy(self) -> int | None:
        return self._busy

    def seconds(self, copy: int) -> float:
        return self._seconds[copy] + (perf_counter() - self._since if self._busy == copy else 0.0)

    def render(self, copy: int) -> NDArray:
        picture = self._copies[copy].render()
        if picture is None:
            raise EnvironmentMismatch("the environment gives no picture: it has no render_mode 'rgb_array'")
        return np.asarray(picture, dtype=np.uint8)

    def close(self) -> None:
        for copy in self._copies:
            copy.close()

    def _timed(self, copy: int, call: Callable[[Given], list[Report]], given: Given) -> list[Report]:
        self._since = perf_counter()
        self._busy = copy
        reports = call(given)
        self._busy = None
        self._seconds[copy] += perf_counter() - self._since
        return reports

    def _restart(self, copy: int, turn: Turn, rows: Rows) -> None:
        episode = self._next_episode(copy)
        if episode is None:
            return
        self._groups[copy] = episode.groups
        self._seconds[copy] = 0.0
        # Some environments hand the seed to a signed integer of 32 bits.
        self._seeds[copy] = episode.seed % 2**31
        while True:
            try:
                reports = self._timed(copy, self._copies[copy].reset, self._seeds[copy])
                break
            except LeagueError:
                raise
            except Exception as error:
                self._crash(copy, error)
        if not any(_must_act(report) for report in reports):
            raise EnvironmentMismatch(
                f"nobody acts in the episode of seed {self._seeds[copy]}: it is over at its reset"
            )
        self._take(copy, reports, turn, rows)

    def _take(self, copy: int, reports: Sequence[Report], turn: Turn, rows: Rows) -> None:
        """Sort an agent's report into who must act and who has left; restart an episode that is over."""
        is_over = True
        for agent, observation, reward, terminated, truncated in reports:
            if not math.isfinite(reward):
                raise InvalidReward(
                    f"agent {self.agents[agent]} got a reward of {reward} in the episode of seed {self._seeds[copy]},"
                    " expected a finite number"
                )
            if terminated or truncated:
                turn.endings.append(Ending(copy, agent, observation, reward, terminated, truncated))
                continue
            is_over = False
            group = self._groups[copy][agent]
            if group not in rows:
                rows[group] = ([], [], [], [])
            copies, agents, observations, rewards = rows[group]
            copies.append(copy)
            agents.append(agent)
            observations.append(observation)
            rewards.append(reward)
        if self._gives_states and (state := self._copies[copy].state()) is not None:
            known = turn.last_states if is_over else turn.states
            known[copy] = np.array(state, dtype=np.float32).ravel()
        if is_over:
            turn.finished.append(copy)
            self._crashes[copy] = 0
            self._restart(copy, turn, rows)

    def _crash(self, copy: int, error: Exception) -> None:
        """Build a copy anew, unless it has crashed too often."""
        self._crashes[copy] += 1
        if self._crashes[copy] > self._most_crashes:
            raise error
        logger.warning(
            "The environment raised in the episode of seed %d and is built anew (%d of %d times in a row): %s: %s",
            self._seeds[copy],
            self._crashes[copy],
            self._most_crashes,
            type(error).__name__,
            error,
        )
        self._busy = None
        with contextlib.suppress(Exception):
            self._copies[copy].close()
        self._copies[copy] = copy_of(self._make(), self._splits)

    def _yield(self, turn: Turn, rows: Rows) -> Turn:
        for group, (copies, agents, observations, rewards) in rows.items():
            turn.batches[group] = Batch(copies, agents, self._stacked(agents, observations), rewards)
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
            f"agent {self.agents[agents[row]]} observes {name} of shape {list(shapes[row])}, its space says"
            f" {list(leaf.shape)}"
        )


def _must_act(report: Report) -> bool:
    return not (report[3] or report[4])


def _splitter(space: Space) -> Callable[[Any], Observation]:
    """Observation → its named arrays; the common forms without the cost of the general one."""
    if not isinstance(space, DictSpace):
        return lambda value: {OBSERVATION: value}
    if set(space.spaces) == {OBSERVATION, ACTION_MASK}:
        plain = not any(isinstance(part, DictSpace) for part in space.spaces.values())
        if plain:
            return lambda value: {OBSERVATION: value[OBSERVATION], ACTION_MASK: value[ACTION_MASK]}
    return lambda value: tensors(space, value)


def _plain(actions: NDArray) -> list[Any]:
    """Discrete actions as Python integers, which environments index lists with; arrays as they are."""
    return actions.tolist() if actions.ndim == 1 else list(actions)
