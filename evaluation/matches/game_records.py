"""Facts about recorded games: forfeits, identity, unique games, and upsets against the ratings. Pure."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

from evaluation.documents import Document, Forfeits
from evaluation.statistics.sequential import score_of
from league.results.records import Match
from league.results.sums import Examples, Pair, game_digest


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
            game_digest(match, game)
            for match in matches
            for game in match.games
            if contestant is None or contestant in (match.contestants[number] for number in game.sides)
        }
    )


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


def greatest_upsets(
    ratings: Mapping[str, float], pairs: Iterable[Pair], examples: Callable[[Pair], Examples], most: int
) -> list[Upset]:
    """At most `most` upsets, greatest first. The greatest of each pair takes precedence over any pair's second.

    Args:
        ratings: Reference → Elo. Contestants without a rating have no upsets.
        pairs: Pairs that have met.
        examples: Reads the examples of a pair's games.
        most: Number of upsets, at most MOST_EXAMPLES.
    """
    # The greatest upset that is possible comes first, so that most pairs are not read.
    rated = sorted(
        (-1 + score_of(-abs(ratings[first] - ratings[second])), (first, second))
        for first, second in pairs
        if first in ratings and second in ratings
    )
    of_pairs: list[list[Upset]] = []
    for greatest, pair in rated:
        if sum(upsets[0].size > -greatest for upsets in of_pairs) >= most:
            break
        if upsets := _upsets_of(pair, examples(pair), ratings)[:most]:
            of_pairs.append(upsets)
    ranked = [(rank, upset) for upsets in of_pairs for rank, upset in enumerate(upsets)]
    selection = sorted(ranked, key=lambda item: (item[0], _order(item[1])))[:most]
    return sorted((upset for _, upset in selection), key=_order)


def _upsets_of(pair: Pair, examples: Examples, ratings: Mapping[str, float]) -> list[Upset]:
    """Upsets of a pair, greatest first, without copies of a game."""
    upsets: dict[int, Upset] = {}
    for (contestant, twice_score), of_kind in examples.items():
        better, other = pair[contestant], pair[1 - contestant]
        expected = score_of(ratings[better] - ratings[other])
        if twice_score / 2 - expected <= MIN_UPSET:
            continue
        for match, game, digest in of_kind:
            upset = Upset(match, game, better, other, expected, twice_score / 2)
            upsets[digest] = min(upset, upsets.get(digest, upset), key=_order)
    return sorted(upsets.values(), key=_order)


def _order(upset: Upset) -> tuple[float, str, int]:
    return -upset.size, upset.match, upset.game
