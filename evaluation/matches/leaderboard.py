"""Leaderboard of a league: the games that count, and returns, scores and ratings of all contestants."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Collection, Mapping, Sequence
from fractions import Fraction
from itertools import groupby
from operator import itemgetter

import numpy as np
from numpy.typing import NDArray

from evaluation.documents import Payoff, RatedVersion, Standing, iso_timestamp
from evaluation.matches.game_records import Upset, greatest_upsets
from evaluation.schedules.builders import ANCHOR
from evaluation.statistics.bradley_terry import Rating, rate
from evaluation.statistics.payoff import tabulate
from league.conditions import Conditions
from league.registry.registry import Registry
from league.registry.storage.rows import AliasEvent, LeagueRow, VersionRow
from league.results.ledger import Ledger
from league.results.records import GAMES_PER_BLOCK, Schedule
from league.results.scoring import scoring
from league.results.sums import Exact, Examples, GameSums, Pair, PairSums, load_examples, merged, outcomes, whole


def compute_leaderboard(registry: Registry, league: str) -> tuple[Standing, ...]:
    """All contestants under the league's current conditions, best first. Raises UnknownLeague."""
    ledger, conditions = Ledger(registry), registry.leagues.get(league).conditions
    sums = ledger.sums(league, ledger.counted(league, conditions))
    return rank_contestants(whole(sums), unrated=registry.versions.exploiter_refs(league))


def rated_version(version: VersionRow, standing: Standing | None, events: Sequence[AliasEvent]) -> RatedVersion:
    """A version with its rating and the times when it became champion. events: history of the champion alias."""
    return RatedVersion(
        ref=version.ref,
        number=version.number,
        made_at=iso_timestamp(version.created_at),
        steps=version.steps,
        parent=version.parent,
        rating=standing.rating if standing else None,
        interval=standing.interval if standing else None,
        games=standing.games if standing else 0,
        champion_at=tuple(iso_timestamp(event.at) for event in reversed(events) if event.version == version.number),
    )


def by_side(
    sides: Sequence[str], sums: Mapping[Pair, PairSums], unrated: Collection[str] = ()
) -> dict[str, tuple[Standing, ...]]:
    """Leaderboard of each side, for leagues that compare contestants on the same side.

    unrated: as in `rank_contestants`.
    """
    return {
        side: rank_contestants(
            {pair: of_pair.sides[number] for pair, of_pair in sums.items() if number in of_pair.sides}, unrated=unrated
        )
        for number, side in enumerate(sides)
    }


def rank_contestants(
    sums: Mapping[Pair, GameSums],
    unique_games: Mapping[str, int] | None = None,
    unrated: Collection[str] = (),
) -> tuple[Standing, ...]:
    """Sum up and rate results, best rating first. Contestants without a rating follow, by score.

    unrated: contestants whose games do not count in ratings: exploiters, which are strong against one version only.
    """
    games: defaultdict[str, int] = defaultdict(int)
    complete: defaultdict[str, int] = defaultdict(int)
    points: defaultdict[str, float] = defaultdict(float)
    returns: defaultdict[str, Exact] = defaultdict(int)
    for pair, of_pair in sums.items():
        number = of_pair.played
        for ref, score, value in zip(pair, of_pair.points, of_pair.returns, strict=True):
            games[ref] += number
            points[ref] += score
            complete[ref] += of_pair.games
            returns[ref] += value
    rated = {pair: of_pair for pair, of_pair in sums.items() if not any(ref in unrated for ref in pair)}
    ratings = rate(outcomes(rated), ANCHOR)
    table = []
    for ref, played in games.items():
        if not played:
            continue
        rating = ratings.get(ref, Rating(None, None, None))
        table.append(
            Standing(
                ref=ref,
                mean_return=float(Fraction(returns[ref]) / complete[ref]) if complete[ref] else None,
                score=points[ref] / played,
                games=played,
                unique_games=None if unique_games is None else unique_games[ref],
                rating=rating.elo,
                interval=None if rating.low is None or rating.high is None else (rating.low, rating.high),
            )
        )
    return tuple(
        sorted(table, key=lambda row: (row.rating is None, -(row.score if row.rating is None else row.rating), row.ref))
    )


MOST_CONTESTANTS = 40
"""Contestants in the payoff matrix, the best ones."""
MAX_UPSETS = 5


class CountedGames:
    """The games of a league that count, from the sums of the ledger.

    leaderboard: contestants, best first, with unique games. sums: by pair of contestants.
    """

    def __init__(self, registry: Registry, league: LeagueRow, conditions: Conditions | None = None) -> None:
        """conditions: of the games, by default those of the league now."""
        self._sides = tuple(league.interface.sides)
        self._is_rated_by_side = scoring(league.config, league.interface) == "side" and len(self._sides) > 1
        self._league, self._ledger = league.slug, Ledger(registry)
        self._schedules = [
            schedule
            for schedule in self._ledger.counted(league.slug, conditions or league.conditions)
            if schedule.sides == self._sides
        ]
        self._unrated = registry.versions.exploiter_refs(league.slug)
        self.sums = self._ledger.sums(league.slug, self._schedules)
        self.matches = sum(of_pair.matches for of_pair in self.sums.values())
        self.unique_games, by_contestant = _unique_games(self._ledger, self._league, self._sides, self._schedules)
        self.leaderboard = rank_contestants(whole(self.sums), by_contestant, self._unrated)

    @property
    def games(self) -> int:
        """Number of games."""
        return GAMES_PER_BLOCK * self.matches

    def payoff(self) -> Payoff | None:
        """Payoff matrix of the best contestants; None before their first game."""
        best = [standing.ref for standing in self.leaderboard[:MOST_CONTESTANTS]]
        between = {pair: of_pair for pair, of_pair in self.sums.items() if set(pair) <= set(best)}
        return tabulate(best, self._sides, between) if between else None

    def by_side(self) -> dict[str, tuple[Standing, ...]]:
        """Leaderboard of each side. Empty if sides are alike or there is only one."""
        return by_side(self._sides, self.sums, self._unrated) if self._is_rated_by_side and self.sums else {}

    def upsets(self) -> list[Upset]:
        """At most MAX_UPSETS of the least expected games, greatest upset first."""
        ratings = {standing.ref: standing.rating for standing in self.leaderboard if standing.rating is not None}
        texts = self._ledger.examples(self._league, self._schedules)

        def examples(pair: Pair) -> Examples:
            return merged([load_examples(text, schedule) for schedule, text in texts[pair]])

        return greatest_upsets(ratings, self.sums, examples, MAX_UPSETS)


def _unique_games(
    ledger: Ledger, league: str, sides: Sequence[str], schedules: Sequence[Schedule]
) -> tuple[int, Counter[str]]:
    """Number of games without copies, of all and of each contestant. sides: those of the schedules."""
    plans = {plan.id: plan for plan in schedules}
    # By players, because copies of a game have the same: many short arrays are sorted sooner than a long one.
    digests: defaultdict[frozenset[str], list[NDArray[np.uint64]]] = defaultdict(list)
    for name, stripes in groupby(ledger.digests(league), key=itemgetter(0)):
        if name not in plans:
            continue
        games = _by_pairing(list(stripes), len(plans[name].pairings))
        for number, pairing in enumerate(plans[name].pairings):
            players = [plans[name].contestants[index] for index in pairing]
            if len(sides) == 1:  # each contestant plays a game alone
                for game, ref in enumerate(players):
                    digests[frozenset([ref])].append(games[:, number, game])
            else:
                digests[frozenset(players)].append(games[:, number].ravel())
    of_contestants: Counter[str] = Counter()
    total = 0
    for refs, parts in digests.items():
        ordered = np.sort(np.concatenate(parts))
        number = int(np.count_nonzero(ordered[1:] != ordered[:-1])) + int(ordered[0] != 0)
        total += number
        of_contestants.update(dict.fromkeys(refs, number))
    return total, of_contestants


def _by_pairing(stripes: Sequence[tuple[str, int, bytes]], pairings: int) -> NDArray[np.uint64]:
    """Digests (rounds, pairings, GAMES_PER_BLOCK) of a schedule's games, 0 where there is no match."""
    parts = [(start, np.frombuffer(data, "<u8").reshape(-1, GAMES_PER_BLOCK)) for _, start, data in stripes]
    rounds = -(-max(start + len(part) for start, part in parts) // pairings)
    games = np.zeros((rounds * pairings, GAMES_PER_BLOCK), np.uint64)
    for start, part in parts:
        games[start : start + len(part)] = part
    return games.reshape(rounds, pairings, GAMES_PER_BLOCK)
