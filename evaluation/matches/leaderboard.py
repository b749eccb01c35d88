"""Leaderboard of a league: the games that count, and returns, scores and ratings of all contestants."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace

from evaluation.documents import Payoff, RatedVersion, Standing, iso_timestamp
from evaluation.matches.game_records import Upset, UpsetFinder, identity
from evaluation.schedules.builders import ANCHOR
from evaluation.statistics.bradley_terry import Rating, rate
from evaluation.statistics.payoff import only_side, tabulate
from league.conditions import Conditions
from league.registry.registry import Registry
from league.registry.storage.rows import AliasEvent, LeagueRow, VersionRow
from league.results.ledger import Ledger
from league.results.records import BlockResult, Game, Match
from league.results.scoring import scoring


def compute_leaderboard(registry: Registry, league: str) -> tuple[Standing, ...]:
    """All contestants under the league's current conditions, best first. Raises UnknownLeague."""
    conditions = registry.leagues.get(league).conditions
    unrated = registry.versions.exploiter_refs(league)
    return rank_contestants(Ledger(registry).results(league, conditions), unrated=unrated)


def rated_version(version: VersionRow, leaderboard: Sequence[Standing], events: Sequence[AliasEvent]) -> RatedVersion:
    """A version with its rating and the times when it became champion. events: history of the champion alias."""
    standing = next((row for row in leaderboard if row.ref == version.ref), None)
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
    sides: Sequence[str], matches: Sequence[Match], unrated: Collection[str] = ()
) -> dict[str, tuple[Standing, ...]]:
    """Leaderboard of each side, for leagues that compare contestants on the same side.

    unrated: as in `rank_contestants`.
    """
    results: dict[str, list[BlockResult]] = {side: [] for side in sides}
    for match in matches:
        for number, side in enumerate(sides):
            games = [_on_side(game, number) for game in match.games]
            part = replace(match, games=tuple(game for game in games if game is not None))
            if part.games:
                results[side].append(part.result())
    return {side: rank_contestants(side_results, unrated=unrated) for side, side_results in results.items()}


def _on_side(game: Game, side: int) -> Game | None:
    """The part of a game that concerns one side, if its contestant played no other side."""
    contestant = game.sides[side]
    if only_side(game, contestant) != side:
        return None
    scores, returns = (
        tuple(v if c == contestant else None for c, v in enumerate(values)) for values in (game.scores, game.returns)
    )
    return replace(game, scores=scores, returns=returns)


def rank_contestants(
    results: Iterable[BlockResult],
    unique_games: Mapping[str, int] | None = None,
    unrated: Collection[str] = (),
) -> tuple[Standing, ...]:
    """Sum up and rate `results`, best rating first. Contestants without a rating follow, by score.

    unrated: contestants whose games do not count in ratings: exploiters, which are strong against one version only.
    """
    results = list(results)
    games: Counter[str] = Counter()
    whole: Counter[str] = Counter()
    points: defaultdict[str, float] = defaultdict(float)
    returns: defaultdict[str, float] = defaultdict(float)
    for block in results:
        for ref, score in zip(block.contestants, block.scores, strict=True):
            games[ref] += block.games
            points[ref] += score
        for ref, value in zip(block.contestants, block.returns or (), strict=block.returns is not None):
            whole[ref] += block.games
            returns[ref] += value
    ratings = rate([block for block in results if not any(ref in unrated for ref in block.contestants)], ANCHOR)
    table = []
    for ref, played in games.items():
        rating = ratings.get(ref, Rating(None, None, None))
        table.append(
            Standing(
                ref=ref,
                mean_return=returns[ref] / whole[ref] if whole[ref] else None,
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
    """The games of a league that count, read from the ledger in small portions to limit memory.

    leaderboard: contestants, best first, with unique games. matches: without moves; those between contestants of the
    payoff matrix, or all if sides are rated.
    """

    def __init__(self, registry: Registry, league: LeagueRow, conditions: Conditions | None = None) -> None:
        """conditions: of the games, by default those of the league now."""
        conditions = conditions or league.conditions
        self._sides = tuple(league.interface.sides)
        self._is_rated_by_side = scoring(league.config, league.interface) == "side" and len(self._sides) > 1
        ledger = Ledger(registry)
        purged = ledger.purged(league.slug)
        schedules = {
            schedule.id: schedule
            for schedule in ledger.schedules(league.slug)
            if schedule.id not in purged and (schedule.conditions, schedule.sides) == (conditions, self._sides)
        }
        self._unrated = registry.versions.exploiter_refs(league.slug)
        results = (result for result in ledger.results(league.slug) if result.schedule in schedules)
        leaderboard = rank_contestants(results, unrated=self._unrated)
        self._best = [standing.ref for standing in leaderboard[:MOST_CONTESTANTS]]
        ratings = {standing.ref: standing.rating for standing in leaderboard if standing.rating is not None}
        self._upsets = UpsetFinder(ratings, MAX_UPSETS)
        self.games = 0
        self.blocks = 0
        self.matches: list[Match] = []
        self._seen: set[bytes] = set()
        self._distinct: Counter[str] = Counter()
        for schedule in schedules.values():
            for match in ledger.walk(schedule):
                self._add(match)
        self.unique_games = len(self._seen)
        self.leaderboard = tuple(
            replace(standing, unique_games=self._distinct[standing.ref]) for standing in leaderboard
        )

    def payoff(self) -> Payoff | None:
        """Payoff matrix of the best contestants; None before their first game."""
        best = set(self._best)
        between = [match for match in self.matches if set(match.contestants) <= best]
        return tabulate(self._best, self._sides, between) if between else None

    def by_side(self) -> dict[str, tuple[Standing, ...]]:
        """Leaderboard of each side. Empty if sides are alike or there is only one."""
        return by_side(self._sides, self.matches, self._unrated) if self._is_rated_by_side and self.matches else {}

    def greatest_upsets(self) -> list[Upset]:
        """At most MAX_UPSETS of the least expected games, greatest upset first."""
        return self._upsets.greatest()

    def _add(self, match: Match) -> None:
        self._upsets.see(match)
        self.blocks += 1
        self.games += len(match.games)
        for game in match.games:
            if (key := identity(match, game)) not in self._seen:
                self._seen.add(key)
                self._distinct.update({match.contestants[number] for number in game.sides})
        if self._is_rated_by_side or all(ref in self._best for ref in match.contestants):
            games = tuple(replace(game, opening=(), actions=()) for game in match.games)
            self.matches.append(replace(match, games=games))
