"""The games whose results were least expected by the ratings. Pure: in which order games are seen changes nothing."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass

from evaluation.gate import identity
from evaluation.sequential import score_of
from league.results.records import Game, Match

LEAST = 0.4
"""A score that is higher than expected by less surprises nobody."""


@dataclass(frozen=True, slots=True)
class Surprise:
    """A recorded game in which `better` scored `score` against `other`, and was expected to score `expected`.

    match, game: where it is in the ledger.
    """

    match: str
    game: int
    better: str
    other: str
    expected: float
    score: float

    @property
    def size(self) -> float:
        return self.score - self.expected


class Surprises:
    """Sees games one by one, and keeps the greatest surprises of each pair of contestants."""

    def __init__(self, ratings: Mapping[str, float], most: int) -> None:
        """ratings: reference → Elo. most: how many are asked for in the end."""
        self._ratings, self._most = ratings, most
        self._kept: defaultdict[tuple[str, ...], dict[bytes, Surprise]] = defaultdict(dict)

    def see(self, match: Match) -> None:
        if any(ref not in self._ratings for ref in match.contestants):
            return
        kept = self._kept[tuple(sorted(match.contestants))]
        for index, game in enumerate(match.games):
            found = _surprise_of(match, index, game, self._ratings)
            if found is None or (len(kept) == self._most and _order(found) >= max(map(_order, kept.values()))):
                continue
            key = identity(match, game)
            # Of one game that was played several times the first by its name stands for all.
            kept[key] = min(found, kept.get(key, found), key=_order)
            if len(kept) > self._most:
                del kept[max(kept, key=lambda each: _order(kept[each]))]

    def greatest(self) -> list[Surprise]:
        """At most `most`, the greatest of each pair before any pair's second, greatest first."""
        ranked = [
            (rank, surprise)
            for kept in self._kept.values()
            for rank, surprise in enumerate(sorted(kept.values(), key=_order))
        ]
        chosen = sorted(ranked, key=lambda item: (item[0], _order(item[1])))[: self._most]
        return sorted((surprise for _, surprise in chosen), key=_order)


def _surprise_of(match: Match, index: int, game: Game, ratings: Mapping[str, float]) -> Surprise | None:
    """From the view of who did better than expected; None if nobody did by much."""
    found = None
    for own, score in enumerate(game.scores):
        if score is None:
            continue
        better, other = match.contestants[own], match.contestants[1 - own]
        expected = score_of(ratings[better] - ratings[other])
        each = Surprise(match.id, index, better, other, expected, score)
        if each.size > (found.size if found else LEAST):
            found = each
    return found


def _order(surprise: Surprise) -> tuple[float, str, int]:
    return -surprise.size, surprise.match, surprise.game
