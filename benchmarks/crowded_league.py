"""How long do reads of the web pages and snapshots take in a league of 200 versions and 100,000 matches, on SQLite?

The league is that of `tests.support.leagues.crowded_league`, with the file in memory.
"""

import os
import re
import statistics
import tempfile
import time
import timeit
from collections.abc import Callable, Iterator
from pathlib import Path

from sqlalchemy import Executable, delete, update

from benchmarks.harness import Quick, Target
from league.registry.registry import Registry
from league.registry.snapshots import SUMMARY
from league.registry.storage import rows
from league.results.ledger import Ledger
from league.subprocesses import Subprocess
from tests.support.leagues.crowded_league import LEAGUE, crowd

READ_MS = 50.0
"""The target for a read, in milliseconds."""


def main(quick: Quick = False) -> Iterator[Target]:
    """Measure the snapshots and the reads of such a league."""
    with tempfile.TemporaryDirectory() as scratch:
        registry = crowd(Path(scratch), *(20, 5_000) if quick else (200, 100_000))
        yield from _snapshots(registry)
        for name, read in _reads(registry).items():
            read()
            seconds = statistics.median(timeit.repeat(read, number=1, repeat=20))
            yield Target(f"read: {name}", round(1000 * seconds, 1), "ms", at_most=READ_MS)
        registry.close()


def _snapshots(registry: Registry) -> Iterator[Target]:
    """Compute the snapshots like the evaluation service: in a low-priority subprocess, including its start."""
    storage = registry.storage
    os.environ |= {"LEAGUE_HOME": str(storage.home), "LEAGUE_DATABASE_URL": storage.database_url}
    stale: dict[str, Executable] = {
        "after one match more": update(rows.SnapshotRow).where(rows.SnapshotRow.part == SUMMARY).values(mark=""),
        "from nothing": delete(rows.SnapshotRow),
    }
    for name, change in stale.items():
        with registry.database.write() as session:
            session.execute(change)
        began = time.perf_counter()
        process, peak = Subprocess("evaluation.service.snapshots", LEAGUE), 0
        while process.is_running:
            peak = max(peak, _memory(process.pid))
            time.sleep(0.01)
        assert process.reap() == 0
        yield Target(f"snapshots {name}", round(time.perf_counter() - began, 1), "s", note=f"{peak / 1024:.0f} MB")
    assert registry.snapshots.stale() == []


def _memory(process: int) -> int:
    """The peak memory of a process in KiB; 0 after it has ended."""
    match = re.search(r"^VmHWM:\s*(\d+) kB", Path(f"/proc/{process}/status").read_text(), re.M)
    return int(match[1]) if match else 0


def _reads(registry: Registry) -> dict[str, Callable[[], object]]:
    ledger = Ledger(registry)
    newest = ledger.page(LEAGUE, limit=50)
    pair = newest[-1].result.contestants[0], newest[-1].result.contestants[1]
    old = f"{ledger.schedules(LEAGUE)[0].id}/0"
    verdict, (training, *_) = registry.verdicts.newest(LEAGUE, limit=1)[0].id, registry.runs.newest(LEAGUE)
    return {
        "the newest 50 matches": lambda: ledger.page(LEAGUE, limit=50),
        "50 matches from the middle": lambda: ledger.page(LEAGUE, before=newest[-1].id, limit=50),
        "the oldest matches": lambda: ledger.page(LEAGUE, before=old, limit=50),
        "50 matches of two": lambda: ledger.page(LEAGUE, contestants=pair, limit=50),
        "no match of two": lambda: ledger.page(LEAGUE, contestants=("script:random", "script:first")),
        "a match with its moves": lambda: (ledger.match(newest[0].id), ledger.entry(newest[0].id)),
        "50 versions": lambda: registry.versions.newest(LEAGUE, limit=50),
        "50 verdicts": lambda: registry.verdicts.newest(LEAGUE, limit=50),
        "the last verdict of each league": registry.verdicts.last_closed,
        "the champion's history": lambda: registry.aliases.history(LEAGUE, limit=50),
        "summaries of all leagues": lambda: registry.snapshots.of_part(SUMMARY),
        "leaderboard": lambda: registry.snapshots.get(LEAGUE, "leaderboard"),
        "the payoff table": lambda: registry.snapshots.get(LEAGUE, "payoff"),
        "ratings": lambda: registry.snapshots.get(LEAGUE, "ratings"),
        "a verdict with its curve": lambda: registry.snapshots.get(LEAGUE, f"verdict/{verdict}"),
        "training runs": lambda: registry.runs.newest(LEAGUE),
        "a training run's points": lambda: registry.runs.points(LEAGUE, training.id),
        "whether anything is new": registry.snapshots.current_marks,
    }
