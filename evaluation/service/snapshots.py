"""Computes the league data that web pages show, so that serving replicas only read rows.

    python -m evaluation.service.snapshots connect_four

| part | content |
|---|---|
| `summary` | counts of games, matches and unique games; scoring, sides and environment; upsets; earlier conditions |
| `leaderboard` | `sides`, `leaderboard` (best first), `by_side`, `not_champion` (why not the best version) |
| `payoff` | payoff matrix of the best contestants, with `shares` of those that have all met; null without games |
| `ratings` | `versions`, oldest first |
| `earlier/<conditions>/leaderboard`, `earlier/<conditions>/payoff` | the same for results under earlier conditions |
| `verdict/<id>` | a verdict with its evidence; its curve has a few hundred points `[block, LLR]` |

The first four parts are replaced together, each verdict and the results under earlier conditions separately, and only
if they are stale. The process can be killed at any time. Several may run, one per league at a time.
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

from evaluation.gating.evidence import verdict_of
from evaluation.matches.leaderboard import CountedGames, rated_version
from evaluation.reporting.gate_record import why_not_champion
from evaluation.service.earlier_results import earlier_results, refresh_earlier_results, tables
from evaluation.statistics.blas import single_threaded_blas
from league.errors import AlreadyRunning, StorageError
from league.registry.registry import Registry
from league.registry.snapshots import FORMAT, SUMMARY
from league.registry.storage.rows import AliasEvent, VerdictRow
from league.results.ledger import Ledger
from league.results.scoring import scoring
from league.settings import Storage
from league.subprocesses import exit_with_parent, lower_priority

logger = logging.getLogger("policy_league")
MOST_POINTS = 400
"""Points of a curve. Charts are not wider in pixels."""


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
    versions = [rated_version(version, leaderboard, events).to_json() for version in registry.versions.all(league)]
    return {
        SUMMARY: {
            "games": played.games,
            "matches": played.blocks,
            "unique_games": played.unique_games,
            "scoring": scoring(row.config, row.interface),
            "actions": row.conditions.actions,
            "sides": sides,
            "environment": row.config.environment.entry_point,
            "environment_digest": row.environment_digest,
            "upsets": [upset.to_json() for upset in played.greatest_upsets()],
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
    """Refresh the league given on the command line."""
    lower_priority()
    registry = Registry.open(Storage.from_environment(), create=False)
    exit_with_parent()
    with suppress(AlreadyRunning):  # by another evaluation service
        refresh(registry, sys.argv[1])


if __name__ == "__main__":
    main()
