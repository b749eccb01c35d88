"""What pages show of a league, computed ahead of time, so that whoever serves them reads rows and computes nothing.

    python -m evaluation.snapshots connect_four

| part | |
|---|---|
| `summary` | `games`, `matches`, `distinct_games` that count; `scoring`, `sides`, `environment`, `environment_digest` |
| `standings` | `sides`, `standings` best first, `by_side` |
| `payoff` | between the best contestants; null before anybody met |
| `ratings` | `versions`, oldest first |
| `verdict/<id>` | a judgement, of whose curve are told some hundred points, [block, LLR] |

The first four are replaced together, each verdict by itself, and nothing that is up to date is computed again. So this
process may be killed at any point, and several may run: of one league one at a time.
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

from evaluation.children import end_with_studio, step_aside
from evaluation.judgement import judgement
from evaluation.one_thread import one_thread
from evaluation.played import Played
from evaluation.schedule import scoring
from evaluation.standings import rated
from evaluation.verdicts import schedules_of
from league.errors import AlreadyRunning, StorageError
from league.registry.registry import Registry
from league.registry.rows import AliasEvent, VerdictRow
from league.registry.snapshots import FORMAT, SUMMARY
from league.results.ledger import Ledger
from league.settings import Storage

logger = logging.getLogger("policy_league")
MOST_POINTS = 400
"""Of a curve: wider than that is no screen's chart."""


def refresh(registry: Registry, league: str) -> None:
    """Bring all of a league's snapshots up to date. Raises UnknownLeague, or AlreadyRunning."""
    registry.league(league)
    with registry.alone(f"snapshots-{league}"), one_thread():
        mark = registry.marks()[league]  # first: what comes while this reads is computed again
        if registry.snapshot_marks(league).get(SUMMARY) != mark:
            _refresh_verdicts(registry, league)
            registry.put_snapshots(league, documents(registry, league), mark)


def documents(registry: Registry, league: str) -> dict[str, Any]:
    """part → document, of all parts but the verdicts. Raises UnknownLeague."""
    row, events = registry.league(league), registry.history(league)
    played = Played(registry, row)
    sides, standings = list(row.interface.sides), played.standings
    by_side = {side: [standing.to_json() for standing in own] for side, own in played.by_side().items()}
    payoff = played.payoff()
    versions = [rated(version, standings, events).to_json() for version in registry.versions(league)]
    return {
        SUMMARY: {
            "games": played.games,
            "matches": played.blocks,
            "distinct_games": played.distinct_games,
            "scoring": scoring(row.config, row.interface),
            "sides": sides,
            "environment": row.config.environment.entry_point,
            "environment_digest": row.environment_digest,
        },
        "standings": {
            "sides": sides,
            "standings": [standing.to_json() for standing in standings],
            "by_side": by_side,
        },
        "payoff": payoff.to_json() if payoff else None,
        "ratings": {"versions": versions},
    }


def _refresh_verdicts(registry: Registry, league: str) -> None:
    """Compute those again of which something has changed: mostly those that are open. Newest first."""
    known, events, played = registry.snapshot_marks(league), registry.history(league), Ledger(registry).counts(league)
    for verdict in reversed(registry.verdicts(league)):
        part, mark = f"verdict/{verdict.id}", _mark(verdict, events, played)
        if known.get(part) == mark:
            continue
        try:
            document = judgement(registry, verdict, events).to_json()
        except StorageError:
            raise
        except Exception:  # one that cannot be told must not keep a league's others from being told
            logger.exception("verdict %s has no snapshot", verdict.id)
            continue
        document["curve"] = thinned(document["curve"])
        registry.put_snapshots(league, {part: document}, mark)


def _mark(verdict: VerdictRow, events: Sequence[AliasEvent], played: Mapping[str, int]) -> str:
    """Of all that a judgement follows from."""
    promoted = any(event.verdict == verdict.id for event in events)
    matches = [played.get(schedule, 0) for schedule in schedules_of(verdict)]
    return f"{FORMAT}; {verdict.outcome}; promoted: {promoted}; matches: {matches}"


def thinned(curve: Sequence[float], most: int = MOST_POINTS) -> list[tuple[int, float]]:
    """(block, LLR) of at most so many blocks, spread evenly, the first and the last among them."""
    kept = range(len(curve)) if len(curve) <= most else [i * (len(curve) - 1) // (most - 1) for i in range(most)]
    return [(index + 1, curve[index]) for index in kept]


def main() -> None:
    """Carry out a studio's order: refresh the league that is named."""
    step_aside()
    registry = Registry.open(Storage.from_environment(), create=False)
    end_with_studio()
    with suppress(AlreadyRunning):  # another studio's process is at it
        refresh(registry, sys.argv[1])


if __name__ == "__main__":
    main()
