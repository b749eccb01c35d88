"""What random openings do to the games of an environment, and how many plies are worth having."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from math import ceil
from statistics import median

from league.environments.adapters import Report
from league.environments.conformance.recordings import Recording, joined
from league.environments.conformance.time_budget import TimeBudget

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


def measure_openings(
    play: Callable[..., Recording], seed: int, budget: TimeBudget, share: float
) -> OpeningMeasurement | None:
    """Play deterministic games with different seeds and, if they repeat each other, random openings.

    Args:
        play: `Examiner.play`.
        seed: Seed of the first game.
        budget: The time for all checks.
        share: Share of the time after which the measurement is given up, except for the number of random openings.

    Returns:
        The measurement, None without enough time. 0 plies are recommended if at least half of the deterministic games
        differ, or if no opening leads to a second position.
    """

    def games(count: int, most: int, actions_seed: int | None = None) -> Iterator[Recording]:
        for number in range(count):
            doing = f"random openings, game {number + 1} of {count}"
            recording = play(seed + number, doing, most, share=share, actions_seed=actions_seed)
            if budget.is_spent(share):
                return
            yield recording

    for most in (0, LONGEST_GAME):
        histories = [tuple(map(_position, game.turns)) for game in games(SEEDS, most, actions_seed=0)]
        if len(histories) < SEEDS:
            return None
        if 2 * (different := len(set(histories))) >= SEEDS:
            return OpeningMeasurement(different, SEEDS, (), 0)
    steps = [game.steps for game in games(SEEDS, LONGEST_GAME)]
    openings = [
        list(map(_position, game.turns[: game.steps + (not game.is_whole)])) for game in games(OPENINGS, LONGEST)
    ]
    if len(steps) < SEEDS or len(openings) < FEWEST_OPENINGS:
        return None
    lengths = []
    for plies in range(1, LONGEST + 1):
        # Position 0 precedes the first step.
        reached = [positions[plies] for positions in openings if len(positions) > plies]
        ended = 1 - len(reached) / len(openings)
        lengths.append(OpeningLength(len(set(reached)) / len(openings), ended, len(openings)))
    return OpeningMeasurement(different, SEEDS, tuple(lengths), recommended(lengths, median(steps)))


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


def _position(reports: Sequence[Report]) -> int:
    return hash(tuple((agent, joined(observation)) for agent, observation, *_ in reports))
