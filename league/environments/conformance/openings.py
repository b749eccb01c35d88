"""What random openings do to the games of an environment, and how many plies are worth having."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from math import ceil
from statistics import median
from typing import Any

import numpy as np
from numpy.typing import NDArray

from league.environments.adapters import EnvAdapter, Observation, Report
from league.environments.conformance.random_actions import RandomActions
from league.environments.conformance.time_budget import TimeBudget
from league.spaces import ACTION_MASK, Box, Discrete, MultiDiscrete, Space
from league.spaces.arrays import bounds, environment_actions

SEEDS = 20
"""Games of deterministic play that are compared."""
OPENINGS, FEWEST_OPENINGS, LONGEST = 200, 50, 8
"""Random openings, the number that suffices on a slow environment, and their length in steps."""
LONGEST_GAME = 100
"""Steps after which a game is compared, or its length counted, as it is."""
DIFFERENT_ENOUGH = 0.8
"""Fraction of the openings that should lead to different positions."""
MANY_ENDED = 0.05
"""Fraction of openings that end the game above which there is a warning."""
SHARE_OF_GAME = 0.2
"""Largest fraction of a game of median length that an opening should take: the rest is what a match measures."""


@dataclass(frozen=True, slots=True)
class OpeningLength:
    """Random openings of one length.

    Attributes:
        distinct: Fraction of the openings whose position no earlier opening reached.
        ended: Fraction of the openings that ended the game. Matches draw these anew.
        openings: Number of openings.
    """

    distinct: float
    ended: float
    openings: int = OPENINGS

    @property
    def positions(self) -> int:
        """Number of different positions."""
        return round(self.distinct * self.openings)

    def __str__(self) -> str:
        positions = f"{self.positions} different position{'s' * (self.positions != 1)}"
        return f"{positions} in {self.openings} games and end {self.ended:.1%} of them"


@dataclass(frozen=True, slots=True)
class OpeningMeasurement:
    """What openings are worth.

    Attributes:
        different_games: Different games of deterministic play, with `games` seeds; at least as many as first
            observations.
        games: Number of seeds.
        lengths: Openings of 1, 2, … steps; empty if seeds alone make the games differ.
        recommended: Recommended value of `play.opening_plies`.
    """

    different_games: int
    games: int
    lengths: tuple[OpeningLength, ...]
    recommended: int

    def __str__(self) -> str:
        least = "at least " * (not self.lengths and self.different_games < self.games)
        games = "the same game" if self.different_games == 1 else f"{least}{self.different_games} different games"
        seeds = f"With deterministic play, {self.games} seeds give {games}"
        if not self.lengths:
            return f"{seeds}: random openings are not needed."
        if not (plies := self.recommended):
            effect = self.effect(len(self.lengths))
            effect = effect[0].lower() + effect[1:]
            return f"{seeds}, and {effect}: they are not recommended, and all games start alike."
        warning = f" {self.warning(plies)}" if self.warning(plies) else ""
        return f"{seeds}. {self.effect(plies)}: play.opening_plies: {plies} is recommended.{warning}"

    def warning(self, plies: int) -> str:
        """A sentence if openings of a measured length end many games, else empty."""
        if self.lengths[plies - 1].ended <= MANY_ENDED:
            return ""
        return f"Openings of {counted_plies(plies)} end many games; matches draw these openings anew."

    def effect(self, plies: int) -> str:
        """What openings of a measured length do, in a sentence without its stop."""
        return f"Random openings of {counted_plies(plies)} reach {self.lengths[plies - 1]}"


def counted_plies(plies: int) -> str:
    """Return `1 ply`, `2 plies`, …"""
    return "1 ply" if plies == 1 else f"{plies} plies"


class _OutOfTimeError(Exception): ...


def measure_openings(
    adapter: EnvAdapter, spaces: Sequence[Space], seed: int, budget: TimeBudget, share: float
) -> OpeningMeasurement | None:
    """Play deterministic games with different seeds and, if they repeat each other, random openings.

    Args:
        adapter: The environment.
        spaces: Action space of each agent.
        seed: Seed of the first game.
        budget: The time for all checks.
        share: Share of the time after which the measurement is given up, except for the number of random openings.

    Returns:
        The measurement, None without enough time. 0 plies are recommended if at least half of the deterministic games
        differ, or if no opening leads to a second position.
    """
    games = _Games(adapter, spaces, budget, share)
    try:
        different = len({games.first_position(seed + i) for i in range(SEEDS)})
        if 2 * different < SEEDS:
            different = len({games.deterministic(seed + i) for i in range(SEEDS)})
        if 2 * different >= SEEDS:
            return OpeningMeasurement(different, SEEDS, (), 0)
        whole = [len(games.random(seed + i, LONGEST_GAME)) for i in range(SEEDS)]
        openings = [games.random(seed + i, LONGEST) for i in range(FEWEST_OPENINGS)]
        with suppress(_OutOfTimeError):
            while len(openings) < OPENINGS:
                openings.append(games.random(seed + len(openings), LONGEST))
    except _OutOfTimeError:
        return None
    lengths = []
    for plies in range(1, LONGEST + 1):
        # Position 0 precedes the first step.
        reached = [positions[plies] for positions in openings if len(positions) > plies]
        ended = 1 - len(reached) / len(openings)
        lengths.append(OpeningLength(len(set(reached)) / len(openings), ended, len(openings)))
    return OpeningMeasurement(different, SEEDS, tuple(lengths), recommended(lengths, median(whole)))


def recommended(lengths: Sequence[OpeningLength], game: float) -> int:
    """The shortest opening that gives enough positions, within the share of a game that openings may take.

    Without enough positions, the shortest one with the most. Lengths that end many games are avoided. 0 if openings do
    not give a second position.
    """
    most = max(1, min(len(lengths), ceil(SHARE_OF_GAME * game)))
    choices = [plies for plies in range(1, most + 1) if lengths[plies - 1].ended <= MANY_ENDED] or [1]
    enough = next((plies for plies in choices if lengths[plies - 1].distinct >= DIFFERENT_ENOUGH), None)
    best = enough or max(choices, key=lambda plies: lengths[plies - 1].positions)
    return best if lengths[best - 1].positions > 1 else 0


class _Games:
    """Plays games as long as the time allows."""

    def __init__(self, adapter: EnvAdapter, spaces: Sequence[Space], budget: TimeBudget, share: float) -> None:
        self._adapter, self._spaces, self._budget, self._share = adapter, spaces, budget, share
        self._actions = RandomActions(spaces)
        self._played = 0

    def first_position(self, seed: int) -> bytes:
        """Return the observations after a reset."""
        return _position(self._reset(seed))

    def deterministic(self, seed: int) -> bytes:
        """Return all observations of a game in which each agent takes its first legal action."""
        positions, last = self._game(seed, LONGEST_GAME, lambda agent, mask: _first(self._spaces[agent], mask))
        return b"".join([*positions, last])

    def random(self, seed: int, steps: int) -> list[bytes]:
        """Return the positions of a game with random legal actions in which an agent must act."""
        self._actions.seed(seed)
        return self._game(seed, steps + 1, self._actions.draw)[0]

    def _reset(self, seed: int) -> list[Report]:
        if self._budget.is_spent(self._share):
            raise _OutOfTimeError
        self._played += 1
        self._budget.report(f"random openings, game {self._played}")
        return self._adapter.reset(seed)

    def _game(
        self, seed: int, steps: int, choose: Callable[[int, NDArray[Any] | None], Any]
    ) -> tuple[list[bytes], bytes]:
        """Return the positions in which an agent must act, and the last one, empty if the game is not over."""
        positions: list[bytes] = []
        reports = self._reset(seed)
        for _ in range(steps):
            moves = [
                (agent, choose(agent, observation.get(ACTION_MASK)))
                for agent, observation, _, terminated, truncated in reports
                if not (terminated or truncated)
            ]
            if not moves:
                return positions, _position(reports)
            positions.append(_position(reports))
            if self._budget.is_spent(self._share):
                raise _OutOfTimeError
            reports = self._adapter.step(moves)
        return positions, b""


def _position(reports: Sequence[Report]) -> bytes:
    return b"".join(bytes([agent % 256]) + joined(observation) for agent, observation, *_ in reports)


def joined(observation: Observation) -> bytes:
    """Return the values of an observation as bytes."""
    return b"".join(np.ascontiguousarray(array).tobytes() for array in observation.values())


def _first(space: Space, mask: NDArray[Any] | None) -> Any:
    """Return the first legal action, or the value of a Box that is nearest to 0."""
    if isinstance(space, Box):
        action = np.clip(np.zeros(space.shape), *bounds(space))
    else:
        assert isinstance(space, Discrete | MultiDiscrete), "other actions are a fault, and no game is played"
        choices = np.ravel(space.nvec if isinstance(space, MultiDiscrete) else space.n)
        allowed = np.ones(choices.sum()) if mask is None else mask != 0
        raw = np.array([part.argmax() for part in np.split(allowed, np.cumsum(choices)[:-1])])
        action = np.asarray(space.start) + raw.reshape(space.shape)
    return environment_actions(action[np.newaxis].astype(space.dtype), space)[0]
