"""Sums over the matches of two contestants, from which ratings, payoffs and leaderboards are computed.

The ledger keeps them for each schedule, in the transaction that adds the matches. Sums are exact rational numbers and
counts, so they do not depend on the order of the matches, and sums of schedules can be added. Intervals need no more of
a match than its outcome: how many matches ended alike is part of the sums.
"""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from functools import lru_cache
from hashlib import blake2b
from heapq import nsmallest
from typing import Any, NamedTuple

from league.results.records import Game, Match, Outcome

Exact = int | Fraction
Pair = tuple[str, str]
"""Two contestants in alphabetical order."""
MOST_EXAMPLES = 5
"""Examples of each kind of a schedule's games between two contestants."""
_ENCODER = json.JSONEncoder(separators=(",", ":"))


@dataclass(slots=True)
class GameSums:
    """Sums over games of two contestants.

    Attributes:
        outcomes: (games of each, twice the score of the first, twice that of the second) in a match → such matches.
        complete: Matches without a forfeit.
        games: Games of each contestant in complete matches.
        returns: Sums of the contestants' returns over these games.
        gap: Sum over complete matches of the difference of mean returns, the first's minus the second's.
        squares: Sum of the squares of these differences.
    """

    outcomes: Counter[tuple[int, int, int]] = field(default_factory=Counter)
    complete: int = 0
    games: int = 0
    returns: tuple[Exact, Exact] = (0, 0)
    gap: Exact = 0
    squares: Exact = 0

    def add(self, addend: GameSums) -> None:
        """Add the sums over other games of the same contestants."""
        self.outcomes.update(addend.outcomes)
        self.complete += addend.complete
        self.games += addend.games
        self.returns = (self.returns[0] + addend.returns[0], self.returns[1] + addend.returns[1])
        self.gap += addend.gap
        self.squares += addend.squares

    def count(self, scores: tuple[int, int], games: int, returns: tuple[Exact, Exact] | None, matches: int) -> None:
        """Add equal matches. scores: twice those of the contestants. returns: None with a forfeit."""
        self.outcomes[games, *scores] += matches
        if returns is not None:
            gap = Fraction(returns[0] - returns[1]) / games
            self.complete += matches
            self.games += matches * games
            self.returns = (self.returns[0] + matches * returns[0], self.returns[1] + matches * returns[1])
            self.gap += matches * gap
            self.squares += matches * gap * gap

    @property
    def played(self) -> int:
        """Number of games of each contestant."""
        return sum(games * matches for (games, _, _), matches in self.outcomes.items())

    @property
    def points(self) -> tuple[float, float]:
        """Sums of the scores of the contestants."""
        first = second = 0
        for (_, one, two), matches in self.outcomes.items():
            first += one * matches
            second += two * matches
        return first / 2, second / 2

    def dump(self) -> list[Any]:
        """Return a JSON document, equal for equal sums."""
        outcomes = sorted([*key, matches] for key, matches in self.outcomes.items())
        exact = [
            number.numerator if number.denominator == 1 else [number.numerator, number.denominator]
            for number in (*self.returns, self.gap, self.squares)
        ]
        return [outcomes, self.complete, self.games, *exact]

    @classmethod
    def load(cls, document: Sequence[Any]) -> GameSums:
        """Return the sums that `dump` wrote."""
        outcomes, complete, games, *exact = document
        first, second, gap, squares = (number if isinstance(number, int) else Fraction(*number) for number in exact)
        counts = Counter({(of_each, one, two): matches for of_each, one, two, matches in outcomes})
        return cls(counts, complete, games, (first, second), gap, squares)


@dataclass(slots=True)
class PairSums:
    """Sums over the matches of two contestants.

    Attributes:
        matches: Their number.
        whole: Over all games; empty for games in one team, which compare nobody.
        sides: Side (index) → over the games in which the contestants played this side and no other.
    """

    matches: int = 0
    whole: GameSums = field(default_factory=GameSums)
    sides: dict[int, GameSums] = field(default_factory=dict)

    def add(self, addend: PairSums) -> None:
        """Add the sums over other matches of the same contestants."""
        self.matches += addend.matches
        self.whole.add(addend.whole)
        for side, of_side in addend.sides.items():
            self.sides.setdefault(side, GameSums()).add(of_side)

    def count(self, games: Sequence[_Result], is_swapped: bool, matches: int) -> None:
        """Add equal matches. is_swapped: whether the second contestant of the match is the first by name."""
        order = (1, 0) if is_swapped else (0, 1)
        self.matches += matches
        if all(score is None for game in games for score in game.scores):
            return
        has_forfeit = any(game.has_forfeit for game in games)
        _count(self.whole, games, None, order, has_forfeit, matches)
        for side in range(len(games[0].sides)):
            if any(_counts(game, contestant, side) for game in games for contestant in order):
                _count(self.sides.setdefault(side, GameSums()), games, side, order, has_forfeit, matches)

    def dump(self) -> str:
        """Return the sums as JSON, equal for equal sums."""
        sides = [[side, self.sides[side].dump()] for side in sorted(self.sides)]
        return _ENCODER.encode([self.matches, self.whole.dump(), sides])

    @classmethod
    def load(cls, text: str) -> PairSums:
        """Return the sums that `dump` wrote."""
        matches, whole, sides = json.loads(text)
        return cls(matches, GameSums.load(whole), {side: GameSums.load(document) for side, document in sides})


@lru_cache(maxsize=8192)
def total(texts: tuple[str, ...]) -> PairSums:
    """Return the sums over the matches of some schedules, which `PairSums.dump` wrote. They must not be changed.

    Recent results are kept: after a new match, the sums of all other pairs are those of before.
    """
    sums = PairSums()
    for text in texts:
        sums.add(PairSums.load(text))
    return sums


class _Result(NamedTuple):
    """What sums contain of a game."""

    sides: tuple[int, ...]
    scores: tuple[float | None, ...]
    returns: tuple[float | None, ...]
    has_forfeit: bool


def tally(matches: Iterable[Match]) -> dict[Pair, PairSums]:
    """Return the sums over matches, by pair of contestants."""
    # Many matches of a game have equal results.
    alike = Counter(
        (
            match.contestants,
            tuple([_Result(game.sides, game.scores, game.returns, bool(game.forfeits)) for game in match.games]),
        )
        for match in matches
    )
    sums: defaultdict[Pair, PairSums] = defaultdict(PairSums)
    for (contestants, games), number in alike.items():
        pair = pair_of(contestants)
        sums[pair].count(games, pair != contestants, number)
    return dict(sums)


def pair_of(contestants: Sequence[str]) -> Pair:
    """Return two contestants in alphabetical order."""
    first, second = sorted(contestants)
    return first, second


def whole(sums: Mapping[Pair, PairSums]) -> dict[Pair, GameSums]:
    """Return the sums over all games of each pair."""
    return {pair: of_pair.whole for pair, of_pair in sums.items()}


def outcomes(sums: Mapping[Pair, GameSums]) -> Iterator[Outcome]:
    """Iterate over the different outcomes of the matches of each pair."""
    for pair, of_pair in sums.items():
        for (games, first, second), matches in of_pair.outcomes.items():
            yield Outcome(pair, games, (first / 2, second / 2), matches)


def _count(
    into: GameSums,
    games: Sequence[_Result],
    side: int | None,
    order: tuple[int, int],
    has_forfeit: bool,
    matches: int,
) -> None:
    """Add equal matches. side: count the games of each contestant in which it played only this side; None: all."""
    scores, returns, number = [0, 0], [Fraction(), Fraction()], [0, 0]
    for place, contestant in enumerate(order):
        for game in games:
            value = game.returns[contestant]
            if value is not None and _counts(game, contestant, side):
                number[place] += 1
                returns[place] += Fraction(value)
                scores[place] += int(2 * (game.scores[contestant] or 0.0))
    into.count((scores[0], scores[1]), number[0], None if has_forfeit else (returns[0], returns[1]), matches)


def _counts(game: _Result, contestant: int, side: int | None) -> bool:
    return side is None or (game.sides[side] == contestant and game.sides.count(contestant) == 1)


class Example(NamedTuple):
    """A game of a kind, such as one that the first of two contestants has won."""

    match: str
    game: int
    digest: int


Kind = tuple[int, int]
"""Contestant (0 for the first by name), and twice its score."""
Examples = dict[Kind, list[Example]]
"""Kind of games → the first of them by name, without copies of a game."""


def examples(matches: Iterable[Match], digests: Iterable[Sequence[int]]) -> dict[Pair, Examples]:
    """Return examples of each pair's games in which a contestant scored, by its score. digests: of the games."""
    collected: defaultdict[Pair, Examples] = defaultdict(lambda: defaultdict(list))
    for match, of_match in zip(matches, digests, strict=True):
        pair = pair_of(match.contestants)
        for number, (game, digest) in enumerate(zip(match.games, of_match, strict=True)):
            for contestant, score in enumerate(game.scores):
                if score:
                    place = contestant if pair == match.contestants else 1 - contestant
                    collected[pair][place, int(2 * score)].append(Example(match.id, number, digest))
    return {pair: merged([of_pair]) for pair, of_pair in collected.items()}


def merged(parts: Sequence[Examples]) -> Examples:
    """Return the examples of all parts."""
    kinds = sorted({kind for part in parts for kind in part})
    return {kind: _first(example for part in parts for example in part.get(kind, ())) for kind in kinds}


def _first(candidates: Iterable[Example]) -> list[Example]:
    """The first by name, of copies of a game only the first."""
    by_digest: dict[int, Example] = {}
    for example in candidates:
        if example < by_digest.setdefault(example.digest, example):
            by_digest[example.digest] = example
    return nsmallest(MOST_EXAMPLES, by_digest.values())


def dump_examples(of_pair: Examples) -> str:
    """Return examples of one schedule as JSON."""
    kinds = [
        [*kind, [[int(example.match.rpartition("/")[2]), *example[1:]] for example in of_kind]]
        for kind, of_kind in sorted(of_pair.items())
    ]
    return _ENCODER.encode(kinds)


def load_examples(text: str, schedule: str) -> Examples:
    """Return the examples of a schedule that `dump_examples` wrote."""
    return {
        (contestant, score): [Example(f"{schedule}/{position}", game, digest) for position, game, digest in of_kind]
        for contestant, score, of_kind in json.loads(text)
    }


def game_digest(match: Match, game: Game) -> int:
    """Return a digest of a game's players, moves and returns, at least 1. Copies of a game have equal digests."""
    players = sorted({match.contestants[contestant] for contestant in game.sides})
    content = repr((players, game.opening, game.actions, sorted(map(repr, game.returns))))
    return int.from_bytes(blake2b(content.encode(), digest_size=8).digest(), "little") or 1
