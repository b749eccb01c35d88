"""The sequential test of a gate, which decides `promote`, `reject` or `inconclusive`.

The evidence is the score of each block, tested by a GSPRT on Elo. With the model `returns` it is the difference of
returns, tested by betting. A decision is a function of the settings and of the blocks in schedule order. It does not
depend on completion times, the number of workers, or blocks after the stopping block.

A test observes blocks against one opponent, or rounds in which candidate and champion are compared. In a round,
candidate and champion each play a block against an exploiter or an anchor from the same seed, opening and seats. With
their scores s in [0, 1], the observation is (1 + s_candidate - s_champion) / 2, the score of a contest in which the
candidate beats the champion by scoring more. What an opening is worth against the opponent cancels.

In the test of exploitability a round has several pairs of blocks, one for each pair of exploiters, all from the same
seed. s is then the mean over the blocks of a round, because these are not independent.

evaluation/gating/gate_result.py combines the tests of a candidate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from evaluation.matches.game_records import forfeit_difference, unique_games
from evaluation.statistics.sequential import BettingTest, EloEstimate, bounds, elo_estimate, gsprt_llr
from league.config.gate import GateConfig
from league.errors import BoundExceeded
from league.results.records import GAMES_PER_BLOCK, Match

Outcome = Literal["promote", "reject", "inconclusive"]


@dataclass(frozen=True, slots=True)
class SequentialTest:
    """A sequential test of a candidate.

    Attributes:
        settings: The gate's settings, with the hypotheses of this test.
        candidate: Reference of the candidate.
        champion: For a comparison with the champion against others, the contestant of every second match. None for a
            test against one opponent.
        pairs: Pairs of matches in a round.
        at_least: Observations to be made even if fewer decide the test.
    """

    settings: GateConfig
    candidate: str
    champion: str | None = None
    pairs: int = 1
    at_least: int = 0

    @property
    def matches_each(self) -> int:
        """Matches per observation."""
        return 1 if self.champion is None else 2 * self.pairs


@dataclass(frozen=True, slots=True)
class Observations:
    """Observations of a test, in schedule order.

    Attributes:
        scores: The candidate's score in each observation, in [0, 1].
        comparisons: Scores are multiples of 1 / (2 * comparisons).
        differences: Differences of returns within ±`return_bound`; empty unless the gate tests returns.
        of_candidate: Mean score of the candidate's blocks in each observation.
        of_champion: Mean score of the champion's blocks; empty for a test against one opponent.
    """

    scores: list[float]
    comparisons: int
    differences: list[float]
    of_candidate: list[float]
    of_champion: list[float]

    def first(self, number: int) -> Observations:
        """The first ones."""
        values = (self.scores, self.differences, self.of_candidate, self.of_champion)
        scores, differences, of_candidate, of_champion = (series[:number] for series in values)
        return Observations(scores, self.comparisons, differences, of_candidate, of_champion)

    @property
    def gaps(self) -> list[float]:
        """What the candidate achieved more than the champion in each round, in the unit of the test's margin."""
        return [2 * d for d in self.differences] or [2 * score - 1 for score in self.scores]

    @property
    def means(self) -> tuple[float, float]:
        """Mean scores of candidate and champion. Requires at least one round."""
        return sum(self.of_candidate) / len(self.of_candidate), sum(self.of_champion) / len(self.of_champion)


def observe(test: SequentialTest, matches: Sequence[Match]) -> Observations:
    """Observe matches. The matches of an incomplete last round are ignored.

    matches: in schedule order.
    """
    comparisons = matches[0].result().games if matches else GAMES_PER_BLOCK
    if test.champion is None:
        scores, differences = _blocks(test.settings, matches, test.candidate)
        return Observations(scores, comparisons, differences, scores, [])
    whole = matches[: len(matches) // test.matches_each * test.matches_each]
    by_contestant = [
        [np.reshape(values, (-1, test.pairs)).mean(axis=1) if values else np.empty(0) for values in blocks]
        for blocks in (
            _blocks(test.settings, whole[::2], test.candidate),
            _blocks(test.settings, whole[1::2], test.champion),
        )
    ]
    (candidate, candidate_returns), (champion, champion_returns) = by_contestant
    return Observations(
        scores=((1 + candidate - champion) / 2).tolist(),
        comparisons=2 * test.pairs * comparisons,
        differences=((candidate_returns - champion_returns) / 2).tolist(),
        of_candidate=candidate.tolist(),
        of_champion=champion.tolist(),
    )


def _blocks(settings: GateConfig, matches: Sequence[Match], contestant: str) -> tuple[list[float], list[float]]:
    """Score of a contestant in each block, and its difference of returns if the gate tests returns."""
    scores = [match.score(match.contestants.index(contestant)) for match in matches]
    return scores, _differences(settings, matches, contestant) if settings.model == "returns" else []


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


@dataclass(frozen=True, slots=True)
class Decision:
    """State of a sequential test.

    Attributes:
        outcome: None while the test is open.
        llr: LLR after the last counted block; 0.0 without blocks.
        bounds: The values of the LLR at which the test decides.
        blocks: Counted blocks. A decided test stopped at the last of them.
        games: Games of these blocks.
        unique_games: Distinct games among them; None if the moves are unknown.
        counts: Blocks per cell, worst for the candidate first.
        curve: LLR after each block. For a betting test, the log wealth of the bettor against H0 (positive) or against
            H1 (negative), whichever is larger.
        estimate: Logistic Elo of the candidate above its opponent; None without blocks, and for a comparison of
            candidate and champion against exploiters.
        counted: The matches of the counted blocks, in schedule order; empty if the decision was made from scores.
        observations: Those of the counted blocks; None if the decision was made from scores.
    """

    outcome: Outcome | None
    llr: float
    bounds: tuple[float, float]
    blocks: int
    games: int
    unique_games: int | None
    counts: tuple[int, ...]
    curve: tuple[float, ...]
    estimate: EloEstimate | None
    counted: Sequence[Match] = ()
    observations: Observations | None = None

    @property
    def score(self) -> float | None:
        """The candidate's mean score over the counted blocks; None without blocks."""
        top = len(self.counts) - 1
        return sum(i * n for i, n in enumerate(self.counts)) / (top * self.blocks) if self.blocks else None


def decide(
    settings: GateConfig,
    block_scores: Sequence[float],
    comparisons: int = 2,
    differences: Sequence[float] = (),
) -> Decision:
    """Decide from the candidate's score in each block.

    The outcome is `promote` at the first block whose LLR reaches the upper bound, `reject` at the lower bound, and
    `inconclusive` at `max_blocks`. Blocks after the stopping block do not count.

    Args:
        settings: Configuration of the gate.
        block_scores: Mean score in [0, 1] of each block, in schedule order.
        comparisons: Comparisons per block: 2 if both games compare the contestants, 1 if each contestant plays one
            game.
        differences: Return of the candidate minus that of its opponent in each block, for the model `returns`.

    Raises:
        ValueError: For impossible scores.
        BoundExceeded: For a difference beyond `return_bound`.
    """
    limits = decision_bounds(settings)
    counts = _cumulated(block_scores[: settings.max_blocks], comparisons)
    if settings.model == "returns":
        curve = _wealth(settings, differences[: settings.max_blocks])
    else:
        curve = gsprt_llr(counts, settings.elo0, settings.elo1, settings.model)
    crossed = _crossed(curve, limits)
    blocks = int(crossed[0]) + 1 if crossed.size else len(counts)
    outcome: Outcome | None = None
    if crossed.size:
        outcome = "promote" if curve[blocks - 1] >= limits[1] else "reject"
    elif blocks == settings.max_blocks:
        outcome = "inconclusive"
    return Decision(
        outcome=outcome,
        llr=float(curve[blocks - 1]) if blocks else 0.0,
        bounds=limits,
        blocks=blocks,
        games=blocks * GAMES_PER_BLOCK,
        unique_games=None,
        counts=tuple(int(n) for n in counts[blocks - 1]) if blocks else (0,) * (2 * comparisons + 1),
        curve=tuple(float(llr) for llr in curve[:blocks]),
        estimate=elo_estimate(counts[blocks - 1]) if blocks else None,
    )


def decide_matches(test: SequentialTest, matches: Sequence[Match]) -> Decision:
    """Decide from matches in schedule order, and count the unique games among those that count.

    A comparison of candidate and champion against exploiters has no estimate in Elo.
    """
    observations = observe(test, matches)
    decision = decide(test.settings, observations.scores, observations.comparisons, observations.differences)
    counted = matches[: decision.blocks * test.matches_each]
    return replace(
        decision,
        games=len(counted) * GAMES_PER_BLOCK,
        unique_games=unique_games(counted),
        estimate=decision.estimate if test.champion is None else None,
        counted=counted,
        observations=observations.first(decision.blocks),
    )


def shadow_shortfall(
    settings: GateConfig, observations: int, failed: int, agreement: float | None, latency_ms: float | None
) -> str | None:
    """Why the observations of a candidate as the champion's shadow are insufficient for promotion.

    Args:
        settings: Configuration of the gate.
        observations: Mirrored observations.
        failed: Requests that the candidate could not answer.
        agreement: Share of observations for which it chose the champion's action.
        latency_ms: 95th percentile of its computation time, in milliseconds.

    Returns:
        A sentence, or None if the candidate may be tested.
    """
    if settings.shadow_agreement is None and settings.latency_ms is None:
        return None
    if observations < settings.shadow_observations or agreement is None or latency_ms is None:
        return (
            f"it has {observations} observations as the champion's shadow, but the gate requires"
            f" {settings.shadow_observations} for shadow_agreement and latency_ms"
        )
    if failed:
        return f"as a shadow it failed to answer {failed} requests"
    if settings.shadow_agreement is not None and agreement < settings.shadow_agreement:
        return (
            f"as a shadow it agreed with the champion on {100 * agreement:.1f} % of {observations} observations,"
            f" but the gate requires {100 * settings.shadow_agreement:.1f} %"
        )
    if settings.latency_ms is not None and latency_ms > settings.latency_ms:
        return (
            f"as a shadow it computed 95 % of the requests within {latency_ms:g} ms,"
            f" but the gate requires {settings.latency_ms:g} ms"
        )
    return None


class SequentialMonitor:
    """Follows the matches of a verdict incrementally and detects the end of its test.

    It processes each block once. `decide_matches` makes the decision itself.
    """

    def __init__(self, test: SequentialTest) -> None:
        self._test, self._is_decided = test, False
        self.bounds = decision_bounds(test.settings)
        self.llr = 0.0
        self._counts: NDArray[np.int64] | None = None
        self._differences: list[float] = []
        self._seen = 0

    def is_over(self, matches: Sequence[Match]) -> bool:
        """Whether the test is decided, and has the observations to be made, or is exhausted.

        matches: all matches of the schedule so far, in order.
        """
        round_size, most = self._test.matches_each, self._test.settings.max_blocks
        end = min(len(matches) // round_size, most)
        if end > self._seen:
            curve = self._curve(observe(self._test, matches[self._seen * round_size : end * round_size]))
            self.llr, self._seen = float(curve[-1]), end
            self._is_decided = self._is_decided or bool(_crossed(curve, self.bounds).size)
        is_sufficient = self._is_decided and self._seen >= self._test.at_least
        return is_sufficient or self._seen >= most

    def _curve(self, new: Observations) -> NDArray[np.float64]:
        settings = self._test.settings
        if settings.model == "returns":
            self._differences += new.differences
            return _wealth(settings, self._differences)
        counts = _cumulated(new.scores, new.comparisons)
        counts = counts if self._counts is None else counts + self._counts
        self._counts = counts[-1]
        return gsprt_llr(counts, settings.elo0, settings.elo1, settings.model)


def cell_counts(matches: Sequence[Match], candidate: str) -> tuple[int, ...]:
    """Number of blocks per cell, worst for the candidate first. Requires at least one match."""
    scores = [match.score(match.contestants.index(candidate)) for match in matches]
    return tuple(int(n) for n in _cumulated(scores, matches[0].result().games)[-1])


def decision_bounds(settings: GateConfig) -> tuple[float, float]:
    """The two values of the LLR, or of the log wealth, at which a test decides."""
    if settings.model != "returns":
        return bounds(settings.alpha, settings.beta)
    lower, upper = _betting(settings).bounds
    return -lower, upper


def _betting(settings: GateConfig) -> BettingTest:
    assert settings.return_bound is not None, "the configuration requires it"
    return BettingTest(settings.return_bound, settings.alpha, settings.beta, settings.return0, settings.return1)


def _wealth(settings: GateConfig, differences: Sequence[float]) -> NDArray[np.float64]:
    """Log wealth of the richer bettor, negative for the bettor against H1."""
    beyond = [d for d in differences if abs(d) > (settings.return_bound or 0)]
    if beyond:
        raise BoundExceeded(
            f"gate.return_bound is {settings.return_bound:g}, but the returns of a block differ by {beyond[0]:g}:"
            " void the verdict (`league void`) and set a bound that no block can exceed"
        )
    against_h1, against_h0 = _betting(settings).curves(np.asarray(differences, dtype=np.float64))
    return np.where(against_h0 >= against_h1, against_h0, -against_h1)


def _cumulated(block_scores: Sequence[float], comparisons: int) -> NDArray[np.int64]:
    """Counts per cell after each block, shape (blocks, 2 comparisons + 1)."""
    halves = np.asarray(block_scores, dtype=np.float64) * 2 * comparisons
    cells = np.rint(halves)
    if not (np.abs(halves - cells) < 1e-6).all() or ((cells < 0) | (cells > 2 * comparisons)).any():
        step = 1 / (2 * comparisons)
        raise ValueError(f"block scores with {comparisons} comparison(s) must be multiples of {step:g} in [0, 1]")
    return np.eye(2 * comparisons + 1, dtype=np.int64)[cells.astype(np.intp)].cumsum(axis=0)


def _crossed(curve: NDArray[np.float64], limits: tuple[float, float]) -> NDArray[np.intp]:
    return np.flatnonzero((curve <= limits[0]) | (curve >= limits[1]))
