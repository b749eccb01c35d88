"""How long do snapshots, page reads and new matches take with 200 versions and a million games?

The league is that of `benchmarks.leagues.crowded_league`, in an SQLite file. Snapshots are computed as by the
evaluation service, in a process of their own, which computes them again after each of some matches between the best
two versions. The processor time of the first ones includes its start. The time of new matches is that of playing chunks
of a tournament and adding them to the ledger, with and without sums, in alternation.
"""

import os
import statistics
import tempfile
import time
import timeit
from collections.abc import Callable, Iterator
from contextlib import closing
from itertools import count, pairwise
from pathlib import Path
from typing import Any
from unittest.mock import patch

import psutil
from sqlalchemy import delete

from benchmarks.harness import Quick, Target, in_rounds
from benchmarks.leagues.crowded_league import LEAGUE, crowd
from evaluation.matches.tournament import evaluate
from league.registry.registry import Registry
from league.registry.snapshots import SUMMARY
from league.registry.storage import rows
from league.results import ledger
from league.results.ledger import Ledger
from league.subprocesses import RequestProcess

READ_MS, NEWS_MS = 50.0, 2.0
"""The targets for a read, and for whether anything is new, in milliseconds."""
NEWS = "whether anything is new"
CURRENT_SECONDS = 1.0
"""The target for the processor time until pages contain one match more."""


def main(quick: Quick = False) -> Iterator[Target]:
    """Measure the snapshots and the reads of such a league."""
    with tempfile.TemporaryDirectory() as scratch:
        registry = crowd(Path(scratch), *(20, 5_000) if quick else (200, 500_000))
        yield from _snapshots(registry, 2 if quick else 9)
        for name, read in _reads(registry).items():
            read()
            seconds = statistics.median(timeit.repeat(read, number=1, repeat=20))
            limit = NEWS_MS if name == NEWS else READ_MS
            yield Target(f"read: {name}", round(1000 * seconds, 2), "ms", at_most=limit)
        yield _new_matches(registry, *(64, 3) if quick else (512, 15))
        registry.close()


def _new_matches(registry: Registry, blocks: int, rounds: int) -> Target:
    """Play a gauntlet of scripts, and compare the rate with that of a ledger without sums."""
    seeds = count()

    def play() -> float:
        began = time.process_time()
        evaluate(
            LEAGUE,
            ["script:random"],
            registry=registry,
            schedule="gauntlet",
            against=["script:one_ply"],
            blocks=blocks,
            seed=next(seeds),
        )
        return blocks / (time.process_time() - began)

    def play_without_sums() -> float:
        with patch.object(ledger, "_add_to_sums"):
            return play()

    rates = in_rounds({"with": play, "without": play_without_sums}, rounds)
    ratio = round(rates["with"] / rates["without"], 3)
    return Target("rate of a tournament", ratio, "×", at_least=0.97, peer="a ledger without sums")


def _snapshots(registry: Registry, matches: int) -> Iterator[Target]:
    """Compute the snapshots like the evaluation service: in a low-priority subprocess."""
    storage = registry.storage
    os.environ |= {"LEAGUE_HOME": str(storage.home), "LEAGUE_DATABASE_URL": storage.database_url}
    with registry.database.write() as session:
        session.execute(delete(rows.SnapshotRow))
    process = RequestProcess("evaluation.service.snapshots", work="computes the snapshots")
    with closing(process):
        process.request(LEAGUE)
        subprocess = psutil.Process(process.pid)
        spent = [_seconds(subprocess)]
        yield Target("snapshots from nothing", round(spent[0], 2), "s", note=_memory(subprocess))
        document: Any = registry.snapshots.of_part("leaderboard")[LEAGUE].document
        best, second = (standing["ref"] for standing in document["leaderboard"][:2])
        for seed in range(matches):
            evaluate(LEAGUE, [best], registry=registry, schedule="gauntlet", against=[second], blocks=1, seed=seed)
            assert registry.snapshots.stale() == [LEAGUE]
            process.request(LEAGUE)
            assert registry.snapshots.stale() == []
            spent.append(_seconds(subprocess))
        seconds = [after - before for before, after in pairwise(spent)]
        note = f"of {matches}, {min(seconds):.2f} to {max(seconds):.2f} s; {_memory(subprocess)}"
        median = round(statistics.median(seconds), 2)
        yield Target("snapshots after one match more", median, "s", at_most=CURRENT_SECONDS, note=note)


def _seconds(process: psutil.Process) -> float:
    spent = process.cpu_times()
    return spent.user + spent.system


def _memory(process: psutil.Process) -> str:
    return f"{process.memory_info().rss / 2**20:.0f} MB"


def _reads(registry: Registry) -> dict[str, Callable[[], object]]:
    recorded = Ledger(registry)
    newest = recorded.page(LEAGUE, limit=50)
    pair = newest[-1].result.contestants[0], newest[-1].result.contestants[1]
    old = f"{recorded.schedules(LEAGUE)[0].id}/0"
    verdict, (training, *_) = registry.verdicts.newest(LEAGUE, limit=1)[0].id, registry.runs.newest(LEAGUE)
    return {
        "the newest 50 matches": lambda: recorded.page(LEAGUE, limit=50),
        "50 matches from the middle": lambda: recorded.page(LEAGUE, before=newest[-1].id, limit=50),
        "the oldest matches": lambda: recorded.page(LEAGUE, before=old, limit=50),
        "50 matches of two": lambda: recorded.page(LEAGUE, contestants=pair, limit=50),
        "no match of two": lambda: recorded.page(LEAGUE, contestants=("script:random", "script:first")),
        "a match with its moves": lambda: (recorded.match(newest[0].id), recorded.entry(newest[0].id)),
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
        NEWS: registry.snapshots.current_marks,
    }
