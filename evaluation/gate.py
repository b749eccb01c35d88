"""The gate: from the blocks of a verdict's schedule to `promote`, `reject` or `inconclusive`.

A decision is a function of the settings and of the blocks in schedule order, and of nothing else: not of when a block
was finished, nor of how many workers played, nor of blocks behind the one at which the test stopped.

The evidence is a block's score, tested by a GSPRT on Elo, or with the model `returns` the difference of its returns,
tested by betting.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass, replace
from hashlib import blake2b
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from evaluation.forfeits import by_rule
from evaluation.sequential import BettingTest, EloEstimate, bounds, elo_estimate, gsprt_llr
from league.config import GateConfig
from league.errors import BoundExceeded
from league.results.records import GAMES_PER_BLOCK, Action, Game, Match

Outcome = Literal["promote", "reject", "inconclusive"]


@dataclass(frozen=True, slots=True)
class Decision:
    """Where a sequential test stands.

    outcome: None while the test is open.
    blocks: how many blocks count; the test stopped at the last of them if it has an outcome.
    counts: how many of those ended in each cell, worst for the challenger first.
    curve: the LLR after each of those blocks; `llr` is its end, 0.0 without blocks. Of a betting test it is the greater
        of two log wealths: who bets against H0 counts up, who bets against H1 down.
    estimate: the challenger's Elo over the champion, logistic as ratings are; None without blocks.
    distinct_games: how many different games are among those that count; None where moves are not known.
    """

    outcome: Outcome | None
    llr: float
    bounds: tuple[float, float]
    blocks: int
    games: int
    distinct_games: int | None
    counts: tuple[int, ...]
    curve: tuple[float, ...]
    estimate: EloEstimate | None

    @property
    def score(self) -> float | None:
        """The challenger's mean score over the blocks that count; None without blocks."""
        top = len(self.counts) - 1
        return sum(i * n for i, n in enumerate(self.counts)) / (top * self.blocks) if self.blocks else None


def decide(
    settings: GateConfig,
    block_scores: Sequence[float],
    comparisons: int = 2,
    differences: Sequence[float] = (),
) -> Decision:
    """Decide on the challenger's mean score in each block, in schedule order.

    `promote` at the first block whose LLR reaches the upper bound, `reject` at the lower one, `inconclusive` at
    `max_blocks` without either. Blocks behind the stopping block do not count.

    comparisons: how often a block compares the two: in both games, or once where each plays a game alone.
    differences: by how much the challenger's return exceeds the other's in each block, for the model `returns`.
    Raises ValueError for scores that such blocks cannot have, and BoundExceeded.
    """
    limits = limits_of(settings)
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
        distinct_games=None,
        counts=tuple(int(n) for n in counts[blocks - 1]) if blocks else (0,) * (2 * comparisons + 1),
        curve=tuple(float(llr) for llr in curve[:blocks]),
        estimate=elo_estimate(counts[blocks - 1], "logistic") if blocks else None,
    )


def judge(settings: GateConfig, matches: Sequence[Match], challenger: str) -> Decision:
    """Decide on matches in schedule order, and count the distinct games among those that count."""
    differences = _differences(settings, matches, challenger) if settings.model == "returns" else ()
    decision = decide(settings, *_block_scores(matches, challenger), differences)
    return replace(decision, distinct_games=distinct_games(matches[: decision.blocks]))


def floor(
    settings: GateConfig, observations: int, failed: int, agreement: float | None, latency_ms: float | None
) -> str | None:
    """Why a challenger may not be promoted, by what it has shown as a shadow of the champion; None if it may.

    observations: how many were mirrored to it. failed: requests that it could not answer. agreement: on which share of
    the observations it took the champion's action. latency_ms: within which it computed 95 % of the requests.
    """
    if settings.shadow_agreement is None and settings.latency_ms is None:
        return None
    if observations < settings.shadow_observations or agreement is None or latency_ms is None:
        return (
            f"it was shown {observations} observations as the champion's shadow, and its gate asks for"
            f" {settings.shadow_observations} to judge shadow_agreement and latency_ms by"
        )
    if failed:
        return f"as a shadow it could not answer {failed} requests"
    if settings.shadow_agreement is not None and agreement < settings.shadow_agreement:
        return (
            f"as a shadow it acted as the champion does on {agreement:.1%} of {observations} observations,"
            f" and its gate asks for {settings.shadow_agreement:.1%}"
        )
    if settings.latency_ms is not None and latency_ms > settings.latency_ms:
        return (
            f"as a shadow it computed 95 % of the requests within {latency_ms:g} ms,"
            f" and its gate asks for {settings.latency_ms:g} ms"
        )
    return None


class Watch:
    """Follows a verdict's matches as they come in, block by block, and knows when its test is over.

    It looks at each block once where `judge` looks at all; the decision itself is `judge`'s.
    """

    def __init__(self, settings: GateConfig, challenger: str) -> None:
        self._settings, self._challenger = settings, challenger
        self.bounds = limits_of(settings)
        self.llr = 0.0
        self._counts: NDArray[np.int64] | None = None
        self._differences: list[float] = []
        self._seen = 0

    def is_over(self, matches: Sequence[Match]) -> bool:
        """Whether the test is decided or exhausted by `matches`, all of the schedule so far in its order."""
        new = matches[self._seen : self._settings.max_blocks]
        if new:
            curve = self._wealth(new) if self._settings.model == "returns" else self._llr(new)
            self.llr = float(curve[-1])
            self._seen += len(new)
            if _crossed(curve, self.bounds).size:
                return True
        return self._seen >= self._settings.max_blocks

    def _llr(self, new: Sequence[Match]) -> NDArray[np.float64]:
        counts = _cumulated(*_block_scores(new, self._challenger))
        counts = counts if self._counts is None else counts + self._counts
        self._counts = counts[-1]
        assert self._settings.model != "returns"
        return gsprt_llr(counts, self._settings.elo0, self._settings.elo1, self._settings.model)

    def _wealth(self, new: Sequence[Match]) -> NDArray[np.float64]:
        self._differences += _differences(self._settings, new, self._challenger)
        return _wealth(self._settings, self._differences)


def counts_of(matches: Sequence[Match], challenger: str) -> tuple[int, ...]:
    """How many of all the blocks ended in each cell, worst for the challenger first; there must be one."""
    return tuple(int(n) for n in _cumulated(*_block_scores(matches, challenger))[-1])


def limits_of(settings: GateConfig) -> tuple[float, float]:
    """The two values of the LLR, or of the log wealth, at which a test decides."""
    if settings.model != "returns":
        return bounds(settings.alpha, settings.beta)
    lower, upper = _betting(settings).bounds
    return -lower, upper


def _betting(settings: GateConfig) -> BettingTest:
    assert settings.return_bound is not None, "the configuration asks for it"
    return BettingTest(settings.return_bound, settings.alpha, settings.beta, settings.return0, settings.return1)


def _wealth(settings: GateConfig, differences: Sequence[float]) -> NDArray[np.float64]:
    """Log wealth of the richer of the two who bet, counted down for who bets against H1."""
    beyond = [d for d in differences if abs(d) > (settings.return_bound or 0)]
    if beyond:
        raise BoundExceeded(
            f"gate.return_bound is {settings.return_bound:g}, but the returns of a block differ by {beyond[0]:g}:"
            " void the verdict (`league void`) and set a bound that no block can exceed"
        )
    against_h1, against_h0 = _betting(settings).curves(np.asarray(differences, dtype=np.float64))
    return np.where(against_h0 >= against_h1, against_h0, -against_h1)


def distinct_games(matches: Iterable[Match], contestant: str | None = None) -> int:
    """How many different games were played, by who met, all moves from the opening on, and the returns.

    Greedy policies in a deterministic game repeat themselves; n copies of one game are not n pieces of evidence.
    contestant: only games in which it took part.
    """
    return len(
        {
            identity(match, game)
            for match in matches
            for game in match.games
            if contestant is None or _took_part(match, game, contestant)
        }
    )


def identity(match: Match, game: Game) -> bytes:
    """16 bytes that are equal for two games that are the same game: a million of them must fit into memory."""
    moves, returns = (_frozen(game.opening), _frozen(game.actions)), sorted(map(repr, game.returns))
    return blake2b(repr((sorted(match.contestants), moves, returns)).encode(), digest_size=16).digest()


def _took_part(match: Match, game: Game, contestant: str) -> bool:
    return contestant in (match.contestants[number] for number in game.sides)


def _frozen(actions: Sequence[Action]) -> tuple[Hashable, ...]:
    return tuple(_frozen(action) if isinstance(action, list) else action for action in actions)


def _block_scores(matches: Sequence[Match], challenger: str) -> tuple[list[float], int]:
    """The challenger's score in each block, and how many comparisons make one."""
    scores = [match.score(match.contestants.index(challenger)) for match in matches]
    return scores, matches[0].result().games if matches else GAMES_PER_BLOCK


def _differences(settings: GateConfig, matches: Sequence[Match], challenger: str) -> list[float]:
    """By how much the challenger's mean return exceeds the other's in each block; by all that it can, either way, where
    one of them forfeited a game.
    """
    bound, gaps = settings.return_bound or 0.0, list[float]()
    for match in matches:
        if (ruled := by_rule(match, challenger)) is not None:
            gaps.append(ruled * bound)
            continue
        own = match.contestants.index(challenger)
        mine, other = match.mean_return(own), match.mean_return(1 - own)
        assert mine is not None
        assert other is not None
        gaps.append(mine - other)
    return gaps


def _cumulated(block_scores: Sequence[float], comparisons: int) -> NDArray[np.int64]:
    """(blocks, 2 comparisons + 1): how many of the blocks so far ended in each cell, after each block."""
    halves = np.asarray(block_scores, dtype=np.float64) * 2 * comparisons
    cells = np.rint(halves)
    if not (np.abs(halves - cells) < 1e-6).all() or ((cells < 0) | (cells > 2 * comparisons)).any():
        step = 1 / (2 * comparisons)
        raise ValueError(f"scores of blocks of {comparisons} comparison(s) are multiples of {step:g} in [0, 1]")
    return np.eye(2 * comparisons + 1, dtype=np.int64)[cells.astype(np.intp)].cumsum(axis=0)


def _crossed(curve: NDArray[np.float64], limits: tuple[float, float]) -> NDArray[np.intp]:
    return np.flatnonzero((curve <= limits[0]) | (curve >= limits[1]))
