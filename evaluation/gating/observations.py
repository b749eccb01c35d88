"""What a sequential test observes: blocks against an opponent, or pairs of blocks against an exploiter.

In a pair, candidate and champion each play a block against the exploiter from the same seed, opening and seats. With
their scores s in [0, 1], the observation is (1 + s_candidate - s_champion) / 2, the score of a contest in which the
candidate beats the champion by scoring more. What an opening is worth against the exploiter cancels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from evaluation.matches.game_records import forfeit_difference
from league.config.gate import GateConfig
from league.results.records import GAMES_PER_BLOCK, Match


@dataclass(frozen=True, slots=True)
class Observations:
    """Observations of a test, in schedule order.

    Attributes:
        scores: The candidate's score in each observation, in [0, 1].
        comparisons: Scores are multiples of 1 / (2 * comparisons).
        differences: Differences of returns within ±`return_bound`; empty unless the gate tests returns.
    """

    scores: list[float]
    comparisons: int
    differences: list[float]

    @property
    def gaps(self) -> list[float]:
        """What the candidate achieved more than the champion in each pair, in the unit of the test's margin."""
        return [2 * d for d in self.differences] or [2 * score - 1 for score in self.scores]


def matches_each(champion: str | None) -> int:
    """Matches per observation. champion: as in `observe`."""
    return 1 if champion is None else 2


def observe(
    settings: GateConfig, matches: Sequence[Match], candidate: str, champion: str | None = None
) -> Observations:
    """Observe matches.

    Args:
        settings: Configuration of the gate.
        matches: Matches in schedule order.
        candidate: Reference of the candidate.
        champion: For a test against an exploiter, the contestant of every second match. A last match without the other
            one of its pair is ignored.
    """
    own, other = matches[::2], matches[1::2]
    if champion is None:
        return _blocks(settings, matches, candidate)
    mine, others = _blocks(settings, own[: len(other)], candidate), _blocks(settings, other, champion)
    return Observations(
        scores=[(1 + s - t) / 2 for s, t in zip(mine.scores, others.scores, strict=True)],
        comparisons=2 * mine.comparisons,
        differences=[(d - e) / 2 for d, e in zip(mine.differences, others.differences, strict=True)],
    )


def _blocks(settings: GateConfig, matches: Sequence[Match], contestant: str) -> Observations:
    scores = [match.score(match.contestants.index(contestant)) for match in matches]
    comparisons = matches[0].result().games if matches else GAMES_PER_BLOCK
    differences = _differences(settings, matches, contestant) if settings.model == "returns" else []
    return Observations(scores, comparisons, differences)


def _differences(settings: GateConfig, matches: Sequence[Match], contestant: str) -> list[float]:
    """Mean return of a contestant minus that of its opponent in each block.

    In blocks with a forfeit, ± `return_bound`, or 0 if both forfeited.
    """
    bound, gaps = settings.return_bound or 0.0, list[float]()
    for match in matches:
        if (ruled := forfeit_difference(match, contestant)) is not None:
            gaps.append(ruled * bound)
            continue
        own = match.contestants.index(contestant)
        mine, other = match.mean_return(own), match.mean_return(1 - own)
        assert mine is not None
        assert other is not None
        gaps.append(mine - other)
    return gaps
