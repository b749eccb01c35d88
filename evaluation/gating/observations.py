"""What a sequential test observes: blocks against an opponent, or rounds in which candidate and champion are compared.

In a round, candidate and champion each play a block against an exploiter or an anchor from the same seed, opening and
seats. With their scores s in [0, 1], the observation is (1 + s_candidate - s_champion) / 2, the score of a contest in
which the candidate beats the champion by scoring more. What an opening is worth against the opponent cancels.

In the test of exploitability a round has several pairs of blocks, one for each pair of exploiters, all from the same
seed. s is then the mean over the blocks of a round, because these are not independent.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from evaluation.gating.sequential_tests import SequentialTest
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
        """What the candidate achieved more than the champion in each round, in the unit of the test's margin."""
        return [2 * d for d in self.differences] or [2 * score - 1 for score in self.scores]


def observe(test: SequentialTest, matches: Sequence[Match]) -> Observations:
    """Observe matches. The matches of an incomplete last round are ignored.

    matches: in schedule order.
    """
    settings, pairs, champion = test.settings, test.pairs, test.champion
    if champion is None:
        return _blocks(settings, matches, test.candidate)
    whole = matches[: len(matches) // test.matches_each * test.matches_each]
    candidate_blocks, champion_blocks = (
        _blocks(settings, whole[::2], test.candidate),
        _blocks(settings, whole[1::2], champion),
    )
    return Observations(
        scores=[(1 + gap) / 2 for gap in _mean_gaps(candidate_blocks.scores, champion_blocks.scores, pairs)],
        comparisons=2 * pairs * candidate_blocks.comparisons,
        differences=[gap / 2 for gap in _mean_gaps(candidate_blocks.differences, champion_blocks.differences, pairs)],
    )


def _mean_gaps(own: Sequence[float], other: Sequence[float], pairs: int) -> list[float]:
    gaps = np.asarray(own, dtype=np.float64) - np.asarray(other, dtype=np.float64)
    return [float(gap) for gap in gaps.reshape(-1, pairs).mean(axis=1)]


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
        index = match.contestants.index(contestant)
        own_return, other_return = match.mean_return(index), match.mean_return(1 - index)
        assert own_return is not None
        assert other_return is not None
        gaps.append(own_return - other_return)
    return gaps
