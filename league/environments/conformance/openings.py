"""What random openings do to the games of an environment, and how many plies are worth having."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil
from statistics import median
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from league.environments.adapters import EnvAdapter, Observation, Report
from league.environments.conformance.random_actions import RandomActions
from league.spaces import ACTION_MASK

SEEDS = 20
"""Games of deterministic play that are compared."""
OPENINGS, LONGEST = 200, 8
"""Random openings, and their length in steps."""
LONGEST_GAME = 100
"""Steps after which a game is compared, or its length counted, as it is."""
DIFFERENT_ENOUGH = 0.8
"""Fraction of the openings that should lead to different positions."""
SHARE_OF_GAME = 0.2
"""Largest fraction of a game of median length that an opening should take: the rest is what a match measures."""


@dataclass(frozen=True, slots=True)
class OpeningLength:
    """Random openings of one length.

    Attributes:
        distinct: Fraction of the openings whose position no earlier opening reached.
        ended: Fraction of the openings that ended the game. Matches draw these anew.
    """

    distinct: float
    ended: float

    def __str__(self) -> str:
        count = round(self.distinct * OPENINGS)
        positions = f"{count} different position{'s' * (count != 1)}"
        return f"{positions} in {OPENINGS} games and end {self.ended:.1%} of them"


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
        plies = self.recommended
        return f"{seeds}. {self.effect(plies)}: play.opening_plies: {plies} is recommended."

    def effect(self, plies: int) -> str:
        """What openings of a measured length do, in a sentence without its stop."""
        return f"Random openings of {'1 ply' if plies == 1 else f'{plies} plies'} reach {self.lengths[plies - 1]}"


def measure_openings(adapter: EnvAdapter, spaces: Sequence[gymnasium.Space[Any]], seed: int) -> OpeningMeasurement:
    """Play deterministic games with different seeds and, if they repeat each other, random openings.

    Args:
        adapter: The environment.
        spaces: Action space of each agent.
        seed: Seed of the first game.

    Returns:
        The measurement. 0 plies are recommended if at least half of the deterministic games differ.
    """
    different = len({_position(adapter.reset(seed + i)) for i in range(SEEDS)})
    if 2 * different < SEEDS:
        different = len({_deterministic_game(adapter, spaces, seed + i) for i in range(SEEDS)})
    if 2 * different >= SEEDS:
        return OpeningMeasurement(different, SEEDS, (), 0)
    random = RandomActions(spaces)
    openings = [_random_game(adapter, random, seed + i, LONGEST) for i in range(OPENINGS)]
    lengths = tuple(_length(openings, plies) for plies in range(1, LONGEST + 1))
    whole = [len(_random_game(adapter, random, seed + i, LONGEST_GAME)) for i in range(SEEDS)]
    return OpeningMeasurement(different, SEEDS, lengths, _recommended(lengths, median(whole)))


def _recommended(lengths: Sequence[OpeningLength], game: float) -> int:
    """The shortest opening that gives enough positions, within the share of a game that openings may take."""
    most = max(1, min(len(lengths), ceil(SHARE_OF_GAME * game)))
    enough = (plies for plies in range(1, most + 1) if lengths[plies - 1].distinct >= DIFFERENT_ENOUGH)
    return next(enough, most)


def _length(openings: Sequence[Sequence[bytes]], plies: int) -> OpeningLength:
    # Position 0 precedes the first step.
    reached = [positions[plies] for positions in openings if len(positions) > plies]
    return OpeningLength(len(set(reached)) / len(openings), 1 - len(reached) / len(openings))


def _deterministic_game(adapter: EnvAdapter, spaces: Sequence[gymnasium.Space[Any]], seed: int) -> bytes:
    """Return all observations of a game in which each agent takes its first legal action."""
    reports, seen = adapter.reset(seed), []
    for _ in range(LONGEST_GAME):
        seen.append(_position(reports))
        moves = [
            (agent, _first(spaces[agent], observation.get(ACTION_MASK)))
            for agent, observation, _, terminated, truncated in reports
            if not (terminated or truncated)
        ]
        if not moves:
            break
        reports = adapter.step(moves)
    return b"".join(seen)


def _random_game(adapter: EnvAdapter, random: RandomActions, seed: int, steps: int) -> list[bytes]:
    """Return the positions of a game with random legal actions in which an agent must act."""
    reports, positions = adapter.reset(seed), []
    random.seed(seed)
    for _ in range(steps + 1):
        moves = [
            (agent, random.draw(agent, observation.get(ACTION_MASK)))
            for agent, observation, _, terminated, truncated in reports
            if not (terminated or truncated)
        ]
        if not moves:
            break
        positions.append(_position(reports))
        reports = adapter.step(moves)
    return positions


def _position(reports: Sequence[Report]) -> bytes:
    return b"".join(bytes([agent % 256]) + joined(observation) for agent, observation, *_ in reports)


def joined(observation: Observation) -> bytes:
    """Return the values of an observation as bytes."""
    return b"".join(np.ascontiguousarray(array).tobytes() for array in observation.values())


def _first(space: gymnasium.Space[Any], mask: NDArray[Any] | None) -> Any:
    """Return the first legal action, or the value of a Box that is nearest to 0."""
    match space:
        case gymnasium.spaces.Discrete():
            return int(space.start) if mask is None else int(np.argmax(mask))
        case gymnasium.spaces.MultiDiscrete():
            if mask is None:
                return np.zeros(space.shape, space.dtype)
            parts = np.split(mask, np.cumsum(space.nvec)[:-1])
            return np.array([np.argmax(part) for part in parts], space.dtype)
        case gymnasium.spaces.Box():
            return np.clip(np.zeros(space.shape, space.dtype), space.low, space.high)
    raise TypeError(f"{space}: expected Discrete, MultiDiscrete or Box")
