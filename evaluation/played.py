"""The games of a league that count: those of its present environment, by its present sides, in no purged schedule."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

from evaluation.gate import identity
from evaluation.pages.surprises import Surprise, Surprises
from evaluation.payoff import tabulate
from evaluation.report import Payoff, Standing
from evaluation.schedule import scoring
from evaluation.standings import by_side, ranked
from league.registry.registry import Registry
from league.registry.rows import LeagueRow
from league.results.ledger import Ledger
from league.results.records import Match

MOST_CONTESTANTS = 40
"""In the payoff table, the best ones: a table of more is read by nobody."""


class Played:
    """Read from the ledger when made, a few matches at a time, so that few of their moves are in memory at once.

    standings: with distinct games. matches: without their moves, of the contestants in the payoff table, or all where
    sides are rated.
    """

    def __init__(self, registry: Registry, league: LeagueRow, most_surprises: int = 0) -> None:
        """most_surprises: how many games that surprise are looked for."""
        self._sides = tuple(league.interface.sides)
        self._is_rated_by_side = scoring(league.config, league.interface) == "side" and len(self._sides) > 1
        ledger = Ledger(registry)
        purged = ledger.purged(league.slug)
        schedules = {
            schedule.id: schedule
            for schedule in ledger.schedules(league.slug)
            if schedule.id not in purged
            and (schedule.environment_digest, schedule.sides) == (league.environment_digest, self._sides)
        }
        standings = ranked(result for result in ledger.results(league.slug) if result.schedule in schedules)
        self._best = [standing.ref for standing in standings[:MOST_CONTESTANTS]]
        ratings = {standing.ref: standing.rating for standing in standings if standing.rating is not None}
        self._surprises = Surprises(ratings, most_surprises) if most_surprises else None
        self.games = 0
        self.blocks = 0
        self.matches: list[Match] = []
        self._seen: set[bytes] = set()
        self._distinct: Counter[str] = Counter()
        for schedule in schedules.values():
            for match in ledger.walk(schedule):
                self._take(match)
        self.distinct_games = len(self._seen)
        self.standings = tuple(replace(each, distinct_games=self._distinct[each.ref]) for each in standings)

    def payoff(self) -> Payoff | None:
        """Between the best contestants; None before anybody of them met."""
        best = set(self._best)
        between = [match for match in self.matches if set(match.contestants) <= best]
        return tabulate(self._best, self._sides, between) if between else None

    def by_side(self) -> dict[str, tuple[Standing, ...]]:
        """Who stands where on each side; empty where sides are alike, or there is one."""
        return by_side(self._sides, self.matches) if self._is_rated_by_side and self.matches else {}

    def greatest_surprises(self) -> list[Surprise]:
        """The games that were least expected, greatest surprise first."""
        return self._surprises.greatest() if self._surprises else []

    def _take(self, match: Match) -> None:
        if self._surprises is not None:
            self._surprises.see(match)
        self.blocks += 1
        self.games += len(match.games)
        for game in match.games:
            if (key := identity(match, game)) not in self._seen:
                self._seen.add(key)
                self._distinct.update({match.contestants[number] for number in game.sides})
        if self._is_rated_by_side or all(ref in self._best for ref in match.contestants):
            games = tuple(replace(game, opening=(), actions=()) for game in match.games)
            self.matches.append(replace(match, games=games))
