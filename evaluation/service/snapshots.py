"""Computes the league data that web pages show, so that serving replicas only read rows.

| part | content |
|---|---|
| `summary` | counts of games, matches and unique games; scoring, sides and environment; upsets; earlier conditions |
| `leaderboard` | `sides`, `leaderboard` (best first), `by_side`, `not_champion` (why not the best version) |
| `payoff` | payoff matrix of the best contestants, with `shares` of those that have all met; null without games |
| `ratings` | `versions`, oldest first |
| `earlier/<conditions>/leaderboard`, `earlier/<conditions>/payoff` | the same for results under earlier conditions |
| `verdict/<id>` | a verdict with its evidence; its curve has a few hundred points `[block, LLR]` |

Results under earlier conditions are those before the game of a league changed, or the way in which versions select
actions. They count in no rating, payoff or verdict of the league, but stay viewable with tables of their own.

The first four parts are replaced together, each verdict and the results under earlier conditions separately, and only
if they are stale. They are functions of the ledger alone. The process computes the snapshots of one league after the
other, and keeps what it has read for the last ones (`league.results.sums.total`), so that new matches cost less than
the results of all. It can be killed at any time. Several may run, one per league at a time.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from evaluation.documents import iso_timestamp
from evaluation.matches.leaderboard import CountedGames, rated_version
from evaluation.reporting.gate_record import why_not_champion
from evaluation.statistics.blas import single_threaded_blas
from evaluation.statistics.population import shares
from league.conditions import Conditions, GameChange, game_changes
from league.errors import AlreadyRunning, StorageError
from league.registry.registry import Registry
from league.registry.snapshots import FORMAT, SUMMARY, earlier_part
from league.registry.storage.rows import AliasEvent, LeagueRow, VerdictRow
from league.results.ledger import Ledger
from league.results.scoring import scoring
from league.settings import Storage
from league.subprocesses import answer_requests, lower_priority

logger = logging.getLogger("policy_league")
MOST_POINTS = 400
"""Points of a curve. Charts are not wider in pixels."""


@dataclass(frozen=True, slots=True)
class EarlierResults:
    """Matches under earlier conditions.

    Attributes:
        conditions: Those of the matches.
        matches: Their number.
        changes: What of the game differs from the current one.
        actions_changed: Whether versions select actions in another way now.
        replaced_at: When the league had this game last; None if it still has it.
    """

    conditions: Conditions
    matches: int
    changes: tuple[GameChange, ...]
    actions_changed: bool
    replaced_at: datetime | None

    def to_json(self) -> dict[str, Any]:
        """Return a JSON document."""
        return {
            "name": self.conditions.name,
            "actions": self.conditions.actions,
            "matches": self.matches,
            "changes": [change._asdict() for change in self.changes],
            "actions_changed": self.actions_changed,
            "replaced_at": self.replaced_at and iso_timestamp(self.replaced_at),
        }


def earlier_results(registry: Registry, league: LeagueRow) -> list[EarlierResults]:
    """Return the earlier conditions under which a league has matches, newest first. Purged ones are left out."""
    ledger, games = Ledger(registry), {row.digest: row for row in registry.leagues.earlier_games(league.slug)}
    purged, played = ledger.purged(league.slug), ledger.counts(league.slug)
    matches: Counter[Conditions] = Counter()
    for schedule in ledger.schedules(league.slug):
        is_earlier = schedule.conditions != league.conditions and schedule.scoring != "team"
        if is_earlier and schedule.id not in purged and schedule.id in played:
            matches[schedule.conditions] += played[schedule.id]
    results = []
    for conditions, number in reversed(matches.items()):
        game = games.get(conditions.game_digest)  # None if only the selection of actions is another one
        results.append(
            EarlierResults(
                conditions=conditions,
                matches=number,
                changes=game_changes(game.game, league.game) if game else (),
                actions_changed=conditions.actions != league.conditions.actions,
                replaced_at=game.replaced_at if game else None,
            )
        )
    return results


def refresh_earlier_results(registry: Registry, league: str) -> None:
    """Recompute the stale tables of results under earlier conditions. Raises UnknownLeague."""
    row, marks = registry.leagues.get(league), registry.snapshots.marks(league)
    for results in earlier_results(registry, row):
        name, mark = results.conditions.name, f"{FORMAT}; {results.matches} matches; {row.interface_digest}"
        if marks.get(earlier_part(name, "leaderboard")) == mark:
            continue
        played = CountedGames(registry, row, conditions=results.conditions)
        documents = tables(played, list(row.interface.sides))
        registry.snapshots.put(league, {earlier_part(name, part): table for part, table in documents.items()}, mark)


def tables(played: CountedGames, sides: Sequence[str], not_champion: str | None = None) -> dict[str, Any]:
    """Return the documents `leaderboard` and `payoff` of some games.

    not_champion: why the best version is not the champion. None for earlier conditions: the champion is that of the
    current ones.
    """
    payoff = played.payoff()
    return {
        "leaderboard": {
            "sides": list(sides),
            "leaderboard": [standing.to_json() for standing in played.leaderboard],
            "by_side": {
                side: [standing.to_json() for standing in standings] for side, standings in played.by_side().items()
            },
            "not_champion": not_champion,
        },
        "payoff": payoff and payoff.to_json() | {"shares": [share.to_json() for share in shares(payoff, played.sums)]},
    }


def refresh(registry: Registry, league: str) -> None:
    """Recompute stale snapshots of a league. Raises UnknownLeague or AlreadyRunning."""
    registry.leagues.get(league)
    with registry.exclusive_lock(f"snapshots-{league}"), single_threaded_blas():
        # Read first, so that games added meanwhile make the snapshots stale.
        mark = registry.snapshots.current_marks()[league]
        if registry.snapshots.marks(league).get(SUMMARY) != mark:
            _refresh_verdicts(registry, league)
            refresh_earlier_results(registry, league)
            registry.snapshots.put(league, documents(registry, league), mark)


def documents(registry: Registry, league: str) -> dict[str, Any]:
    """part → document, except verdicts. Raises UnknownLeague."""
    row, events = registry.leagues.get(league), registry.aliases.history(league)
    played = CountedGames(registry, row)
    sides, leaderboard = list(row.interface.sides), played.leaderboard
    standings = {standing.ref: standing for standing in leaderboard}
    versions = [
        rated_version(version, standings.get(version.ref), events).to_json()
        for version in registry.versions.all(league)
    ]
    return {
        SUMMARY: {
            "games": played.games,
            "matches": played.matches,
            "unique_games": played.unique_games,
            "scoring": scoring(row.config, row.interface),
            "actions": row.conditions.actions,
            "sides": sides,
            "environment": row.config.environment.entry_point,
            "environment_digest": row.environment_digest,
            "upsets": [upset.to_json() for upset in played.upsets()],
            "earlier": [results.to_json() for results in earlier_results(registry, row)],
        },
        **tables(played, sides, why_not_champion(registry, league, leaderboard)),
        "ratings": {"versions": versions},
    }


def _refresh_verdicts(registry: Registry, league: str) -> None:
    """Recompute stale verdicts, newest first."""
    marks, events = registry.snapshots.marks(league), registry.aliases.history(league)
    played = Ledger(registry).counts(league)
    for verdict in reversed(registry.verdicts.all(league)):
        part, mark = f"verdict/{verdict.id}", _mark(verdict, events, played)
        if marks.get(part) == mark:
            continue
        # With Ray it takes longer to import than a league without such verdicts to refresh.
        from evaluation.gating.evidence import verdict_of

        try:
            document = verdict_of(registry, verdict).to_json()
        except StorageError:
            raise
        except Exception:  # one broken verdict must not block the others
            logger.exception("verdict %s has no snapshot", verdict.id)
            continue
        document["curve"] = thinned(document["curve"])
        registry.snapshots.put(league, {part: document}, mark)


def _mark(verdict: VerdictRow, events: Sequence[AliasEvent], played: Mapping[str, int]) -> str:
    """Change token of everything that the evidence of a verdict depends on."""
    promoted = any(event.verdict == verdict.id for event in events)
    matches = [played.get(schedule, 0) for schedule in verdict.schedules]
    return f"{FORMAT}; {verdict.outcome}; promoted: {promoted}; matches: {matches}"


def thinned(curve: Sequence[float], most: int = MOST_POINTS) -> list[tuple[int, float]]:
    """At most `most` points (block, LLR), evenly spaced, including the first and the last."""
    kept = range(len(curve)) if len(curve) <= most else [i * (len(curve) - 1) // (most - 1) for i in range(most)]
    return [(index + 1, curve[index]) for index in kept]


def main() -> None:
    """Refresh the leagues that standard input names, until the parent ends."""
    lower_priority()
    registry = Registry.open(Storage.from_environment(), create=False)

    def respond(league: bytes) -> tuple[dict[str, Any], bytes]:
        with suppress(AlreadyRunning):  # by another evaluation service
            refresh(registry, league.decode().strip())
        return {}, b""

    answer_requests(respond)


if __name__ == "__main__":
    main()
