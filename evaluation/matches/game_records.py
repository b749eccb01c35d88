"""Facts about recorded games: forfeits, identity, unique games, and upsets against the ratings. Pure."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from hashlib import blake2b

from evaluation.documents import Document, Forfeits
from evaluation.statistics.sequential import score_of
from league.results.records import Game, Match


def forfeits(matches: Iterable[Match], contestant: str) -> int:
    """Number of games in `matches` that a contestant forfeited."""
    return sum(
        match.contestants[forfeit.contestant] == contestant
        for match in matches
        for game in match.games
        for forfeit in game.forfeits
    )


def forfeits_of_all(matches: Iterable[Match]) -> dict[str, Forfeits]:
    """Return contestant → its forfeits in `matches`, of those that have any, by name."""
    reasons: defaultdict[str, Counter[str]] = defaultdict(Counter)
    details: defaultdict[str, dict[str, str]] = defaultdict(dict)
    for match in matches:
        for forfeit in (forfeit for game in match.games for forfeit in game.forfeits):
            ref = match.contestants[forfeit.contestant]
            reasons[ref][forfeit.reason] += 1
            if forfeit.detail:
                details[ref].setdefault(forfeit.reason, forfeit.detail)
    return {
        ref: Forfeits(counts.total(), dict(counts.most_common()), details[ref])
        for ref, counts in sorted(reasons.items())
    }


def forfeit_difference(match: Match, contestant: str) -> float | None:
    """Difference of returns that a block with a forfeit counts for, as a share of the maximum; None without a forfeit.

    -1 if only this contestant forfeited a game, +1 if only the other did, 0 if both did.
    """
    own_forfeit = forfeits([match], contestant) > 0
    rival_forfeit = any(forfeits([match], ref) for ref in match.contestants if ref != contestant)
    return float(rival_forfeit) - float(own_forfeit) if own_forfeit or rival_forfeit else None


def unique_games(matches: Iterable[Match], contestant: str | None = None) -> int:
    """Number of distinct games by contestants, moves including the opening, and returns.

    Greedy policies in a deterministic game repeat themselves, and copies of one game are not additional evidence.
    contestant: count only games in which it took part.
    """
    return len(
        {
            identity(match, game)
            for match in matches
            for game in match.games
            if contestant is None or contestant in (match.contestants[number] for number in game.sides)
        }
    )


def identity(match: Match, game: Game) -> bytes:
    """Hash of a game (16 bytes, so that a million fit into memory). Equal games have equal hashes."""
    returns = sorted(map(repr, game.returns))
    return blake2b(
        repr((sorted(match.contestants), game.opening, game.actions, returns)).encode(), digest_size=16
    ).digest()


MIN_UPSET = 0.4
"""Minimum difference between score and expected score."""


@dataclass(frozen=True, slots=True)
class Upset(Document):
    """A recorded game in which `better` scored `score` against `other` although the ratings predicted `expected`.

    match, game: position in the ledger.
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


class UpsetFinder:
    """Scans games one by one and keeps the greatest upsets of each pair of contestants, independent of the order."""

    def __init__(self, ratings: Mapping[str, float], most: int) -> None:
        """ratings: reference → Elo. most: number of upsets to return."""
        self._ratings, self._most = ratings, most
        self._kept: defaultdict[tuple[str, ...], dict[bytes, Upset]] = defaultdict(dict)

    def see(self, match: Match) -> None:
        if any(ref not in self._ratings for ref in match.contestants):
            return
        kept = self._kept[tuple(sorted(match.contestants))]
        for index, game in enumerate(match.games):
            upset = _upset_of(match, index, game, self._ratings)
            if upset is None or (len(kept) == self._most and _order(upset) >= max(map(_order, kept.values()))):
                continue
            key = identity(match, game)
            # The first by name represents equal games.
            kept[key] = min(upset, kept.get(key, upset), key=_order)
            if len(kept) > self._most:
                del kept[max(kept, key=lambda game_key: _order(kept[game_key]))]

    def greatest(self) -> list[Upset]:
        """At most `most` upsets, greatest first. The greatest of each pair takes precedence over any pair's second."""
        ranked = [
            (rank, upset)
            for kept in self._kept.values()
            for rank, upset in enumerate(sorted(kept.values(), key=_order))
        ]
        selection = sorted(ranked, key=lambda item: (item[0], _order(item[1])))[: self._most]
        return sorted((upset for _, upset in selection), key=_order)


def _upset_of(match: Match, index: int, game: Game, ratings: Mapping[str, float]) -> Upset | None:
    """The upset from the view of the contestant that exceeded its expectation; None below MIN_UPSET."""
    greatest = None
    for contestant, score in enumerate(game.scores):
        if score is None:
            continue
        better, other = match.contestants[contestant], match.contestants[1 - contestant]
        expected = score_of(ratings[better] - ratings[other])
        upset = Upset(match.id, index, better, other, expected, score)
        if upset.size > (greatest.size if greatest else MIN_UPSET):
            greatest = upset
    return greatest


def _order(upset: Upset) -> tuple[float, str, int]:
    return -upset.size, upset.match, upset.game
