"""A league of connect four after 200 nightly runs: 200 versions and 100,000 matches, verdicts, promotions and training
runs.

Results are drawn from the logistic model with strengths that increase with each version. The games are real games of
`script:random` against `script:one_ply`, selected by their result, so that they can be replayed. All versions have the
same policy with random weights.

The benchmark measures the duration of the reads of the web pages, on SQLite, and of computing the snapshots of such a
league. Target: 50 ms per read, with the file in memory.
"""

from __future__ import annotations

import argparse
import os
import re
import statistics
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
from sqlalchemy import Executable, delete, update

from benchmarks.leagues.served_league import builder
from evaluation.gating.gate import decide_matches
from evaluation.gating.sequential_tests import SequentialTest
from evaluation.gating.verdicts import conclude, gate_of, open_verdict
from evaluation.matches.tournament import evaluate
from evaluation.schedules.builders import gauntlet, round_robin
from evaluation.service.snapshots import refresh
from league.config.league import LeagueConfig
from league.environments.building import interface
from league.registry.registry import Registry
from league.registry.snapshots import SUMMARY
from league.registry.storage import tables
from league.registry.storage.database import insert
from league.registry.storage.manifest import Manifest
from league.registry.storage.rows import RunState
from league.results.ledger import Ledger, row
from league.results.records import Game, Match, Schedule
from league.results.scoring import admit
from league.settings import Storage
from league.subprocesses import Subprocess

CONFIG = LeagueConfig.load(Path(__file__).parent.parent / "policy_league/configs" / "connect_four.yaml")
CONFIG = CONFIG.model_copy(
    update={
        "gate": CONFIG.gate.model_copy(
            update={"elo1": 60, "max_blocks": 400, "nights": None, "earlier_champions": 0, "confirmation_blocks": 0}
        )
    }
)
"""Nightly runs of some hundred blocks, without anything that requires real games."""
LEAGUE = CONFIG.league
READ_MS = 50.0
"""The target for a read, in milliseconds."""
NEIGHBOURS = 10
"""Number of previous versions that a new one plays against."""
LAST = 40
"""Number of versions that have all played each other, for a complete payoff table."""
RUN_POINTS = 600
"""Number of points of a training run."""


def crowd(home: Path, versions: int = 200, matches: int = 100_000) -> Registry:
    """A registry in `home` with such a league and current snapshots."""
    registry = Registry.open(Storage.at(home))
    registry.leagues.register(CONFIG, interface(CONFIG))
    _Crowd(registry, versions, matches).simulate()
    refresh(registry, LEAGUE)
    return registry


class _Crowd:
    """One nightly run for each version, the last one today."""

    def __init__(self, registry: Registry, versions: int, matches: int) -> None:
        self._registry, self._ledger = registry, Ledger(registry)
        self._versions, self._matches = versions, matches
        self._rng = np.random.default_rng(0)
        self._pool = _Pool(self._rng)
        grown = 900 * (1 - np.exp(-np.arange(versions + 1) / 60)) + 200
        self._elo = {f"{LEAGUE}@{n}": float(elo) for n, elo in enumerate(grown + self._rng.normal(0, 25, versions + 1))}
        self._elo |= {"script:random": 0.0, "script:one_ply": 250.0}
        self._began = datetime.now(UTC) - timedelta(days=versions)
        self._written = 0

    def simulate(self) -> None:
        with tempfile.TemporaryDirectory() as scratch:
            publish = self._publisher(Path(scratch))
            for number in range(1, self._versions + 1):
                publish(number)
                self._night(number)
        self._round_robin()
        for life, state in enumerate(RUNS):
            self._run(life, state)

    def _publisher(self, scratch: Path) -> Callable[[int], object]:
        template = builder(self._registry, 0, (64, 64))(scratch, 0)
        (policy,) = template.policies.values()
        graph = (scratch / policy.file).read_bytes()

        def publish(number: int) -> object:
            parent = number - 1 or None

            def build(directory: Path, version: int) -> Manifest:
                (directory / policy.file).write_bytes(graph)
                made = {"version": version, "parent": parent, "steps": 500_000 * version}
                return template.model_copy(update=made | {"created_at": self._evening(number)})

            return self._registry.publisher.publish(LEAGUE, build, source=f"crowd/{number}", parent=parent)

        return publish

    def _night(self, number: int) -> None:
        """A verdict, and a gauntlet with the remaining matches of this night."""
        league, new = self._registry.leagues.get(LEAGUE), f"{LEAGUE}@{number}"
        champion = self._registry.aliases.current(LEAGUE).get("champion")
        verdict = open_verdict(
            self._registry, league, number, f"{LEAGUE}@{champion}" if champion else "script:random", alpha=0.05
        )
        drawn = list(self._drawn(self._ledger.schedule(verdict.schedule), CONFIG.gate.max_blocks))
        self._write(drawn[: decide_matches(SequentialTest(gate_of(verdict), new), drawn).blocks], number, hour=1)
        conclude(self._registry, verdict)
        self._date(verdict.id, number)
        opponents = [f"{LEAGUE}@{n}" for n in range(max(1, number - NEIGHBOURS), number)]
        opponents += ["script:random", "script:one_ply"]
        left = self._matches * 0.96 * number / self._versions - self._written
        schedule = gauntlet(CONFIG, league.interface, [new], opponents, max(1, round(left / len(opponents))))
        self._write(list(self._drawn(self._ledger.open(schedule), schedule.length)), number, hour=3)

    def _round_robin(self) -> None:
        """The remaining matches, between the last versions."""
        last = [f"{LEAGUE}@{n}" for n in range(max(1, self._versions - LAST + 1), self._versions + 1)]
        pairs = len(last) * (len(last) - 1) // 2
        blocks = max(1, -(-(self._matches - self._written) // pairs))
        schedule = round_robin(CONFIG, self._registry.leagues.get(LEAGUE).interface, last, blocks)
        self._write(list(self._drawn(self._ledger.open(schedule), schedule.length)), self._versions, hour=5)

    def _drawn(self, schedule: Schedule, length: int) -> Iterator[Match]:
        chances = self._rng.random((length, 2))
        for position in range(length):
            first, second = (self._elo[ref] for ref in schedule.contestants_at(position))
            expected = 1 / (1 + 10 ** ((second - first) / 400))
            yield self._pool.match(schedule, position, tuple(float(chance < expected) for chance in chances[position]))

    def _write(self, matches: Sequence[Match], night: int, hour: int) -> None:
        if not matches:
            return
        schedule = self._ledger.schedule(matches[0].schedule)
        for match in matches:
            admit(match, schedule)
        began = self._evening(night) + timedelta(hours=hour)
        rows = [row(match, began + timedelta(seconds=number)) for number, match in enumerate(matches)]
        with self._registry.database.write() as session:
            self._written += insert(session, tables.MatchTable, rows)

    def _date(self, verdict: str, night: int) -> None:
        """Set the dates of a verdict and its promotion to that night."""
        opened, closed = self._evening(night) + timedelta(hours=1), self._evening(night) + timedelta(hours=2)
        with self._registry.database.write() as session:
            of_verdict = tables.VerdictTable.id == verdict
            session.execute(update(tables.VerdictTable).where(of_verdict).values(opened_at=opened, closed_at=closed))
            session.execute(
                update(tables.AliasEventTable).where(tables.AliasEventTable.verdict == verdict).values(at=closed)
            )

    def _evening(self, night: int) -> datetime:
        return self._began + timedelta(days=night - 1)

    def _run(self, number: int, state: RunState) -> None:
        name = f"{self._evening(number + 1):%Y%m%d-%H%M%S}-{number:06x}"
        self._registry.runs.begin(
            LEAGUE,
            name,
            algorithm=CONFIG.training.algorithm,
            settings=CONFIG.training.model_dump(mode="json", by_alias=True),
            seed=number,
            target=CONFIG.training.max_steps,
            parent=number or None,
        )
        walk = np.cumsum(self._rng.normal(0.002, 0.02, (RUN_POINTS, len(CURVES))), axis=0)
        began = self._evening(number + 1)
        points = [
            {
                "league": LEAGUE,
                "run": name,
                "steps": 30_000 * (at + 1),
                "curves": dict(zip(CURVES, map(float, values.round(6)), strict=True)),
                "at": began + timedelta(seconds=10 * at),
            }
            for at, values in enumerate(walk)
        ]
        newest = {"steps": points[-1]["steps"], "curves": points[-1]["curves"], "seconds": 10.0 * RUN_POINTS}
        with self._registry.database.write() as session:
            insert(session, tables.RunPointTable, points)
            session.execute(update(tables.RunTable).where(tables.RunTable.id == name).values(began_at=began, **newest))
        if state != "running":
            self._registry.runs.end(LEAGUE, name, state, "the power was cut" if state == "failed" else None)


RUNS: tuple[RunState, ...] = ("ended", "failed", "stopped", "ended", "running")
CURVES = (
    *("return", "length", "steps_per_second", "shared/return", "shared/length", "shared/entropy"),
    *("shared/policy_loss", "shared/value_loss", "shared/kl", "shared/gradient_norm"),
)


class _Pool:
    """Played blocks by their results: (1.0, 0.0) if contestant 0 won the first game and lost the second."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self._blocks: defaultdict[tuple[float, ...], list[tuple[Game, ...]]] = defaultdict(list)
        with tempfile.TemporaryDirectory() as scratch:
            registry = Registry.open(Storage.at(Path(scratch)))
            registry.leagues.register(CONFIG, interface(CONFIG))
            evaluate(
                LEAGUE,
                ["script:random"],
                registry=registry,
                schedule="gauntlet",
                against=["script:one_ply"],
                blocks=600,
            )
            for match in Ledger(registry).matches(league=LEAGUE):
                for games in (match.games, _exchanged(match.games)):
                    self._blocks[tuple(game.scores[0] or 0.0 for game in games)].append(games)
            registry.close()

    def match(self, schedule: Schedule, position: int, results: tuple[float, ...]) -> Match:
        """The record of a match with these results."""
        known, seed = self._blocks[results], schedule.seed_at(position)
        games = known[self._rng.integers(len(known))]
        return schedule.match(position, [replace(game, seed=seed) for game in games])


def _exchanged(games: Sequence[Game]) -> tuple[Game, ...]:
    """The same block with exchanged contestants."""
    return tuple(
        replace(
            game,
            sides=tuple(1 - contestant for contestant in game.sides),
            returns=game.returns[::-1],
            scores=game.scores[::-1],
        )
        for game in reversed(games)
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Print the durations of creating such a league, of its snapshots, and of reads; 1 if a target was missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="smoke test: 20 versions and 5,000 matches")
    return run(parser.parse_args(argv).quick)


def run(quick: bool = False) -> int:
    """Run the benchmark with its usual settings."""
    versions, matches = (20, 5_000) if quick else (200, 100_000)
    with tempfile.TemporaryDirectory() as scratch:
        began = time.perf_counter()
        registry = crowd(Path(scratch), versions, matches)
        seconds, size = time.perf_counter() - began, (Path(scratch) / "league.db").stat().st_size
        print(f"{versions} versions, {matches:,} matches: made in {seconds:.0f} s, {size / 1e6:.0f} MB", flush=True)
        _report_snapshots(registry)
        met = _report_reads(registry)
        registry.close()
    return int(not met)


def _report_snapshots(registry: Registry) -> None:
    """Compute the snapshots like the evaluation service: in a low-priority subprocess, including its start."""
    print("\nsnapshots | seconds | memory")
    storage = registry.storage
    os.environ |= {"LEAGUE_HOME": str(storage.home), "LEAGUE_DATABASE_URL": storage.database_url}
    stale: dict[str, Executable] = {
        "after one match more": update(tables.SnapshotTable)
        .where(tables.SnapshotTable.part == SUMMARY)
        .values(mark=""),
        "from nothing": delete(tables.SnapshotTable),
    }
    for what, change in stale.items():
        with registry.database.write() as session:
            session.execute(change)
        began = time.perf_counter()
        process, peak = Subprocess("evaluation.service.snapshots", LEAGUE), 0
        while process.is_running:
            peak = max(peak, _memory(process.pid))
            time.sleep(0.01)
        assert process.reap() == 0
        print(f"{what} | {time.perf_counter() - began:.1f} | {peak / 1024:.0f} MB", flush=True)
    assert registry.snapshots.stale() == []


def _memory(process: int) -> int:
    """The peak memory of a process in KiB; 0 after it has ended."""
    found = re.search(r"^VmHWM:\s*(\d+) kB", Path(f"/proc/{process}/status").read_text(), re.M)
    return int(found[1]) if found else 0


def _report_reads(registry: Registry) -> bool:
    print("\nread | median ms | slowest ms | target")
    met = True
    for what, read in _reads(registry).items():
        read()
        took = []
        for _ in range(20):
            began = time.perf_counter()
            read()
            took.append(1000 * (time.perf_counter() - began))
        middle, slowest = statistics.median(took), max(took)
        met &= middle <= READ_MS
        outcome = "met" if middle <= READ_MS else f"MISSED (≤ {READ_MS:g})"
        print(f"{what} | {middle:.1f} | {slowest:.1f} | {outcome}", flush=True)
    return met


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


if __name__ == "__main__":
    sys.exit(main())
