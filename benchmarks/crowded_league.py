"""A league of connect four after 200 nights: 200 versions and 100,000 matches, verdicts, promotions and training runs.

Who wins is drawn by the logistic model from strengths that grow night by night. The games themselves were played: each
is of `script:random` against `script:one_ply`, handed out by its result, so that it can be replayed. The one policy
behind all versions is of random weights.

Run by itself, it tells how long the reads take that pages are made of, on SQLite, and what the snapshots of such a
league take. Targets: 50 ms for a read, once the file is in memory.
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

from benchmarks.served_league import builder
from evaluation import children
from evaluation.gate import judge
from evaluation.schedule import gauntlet, round_robin
from evaluation.snapshots import refresh
from evaluation.tournament import evaluate
from evaluation.verdicts import conclude, gate_of, open_verdict
from league.config import LeagueConfig
from league.environments.building import interface
from league.registry import tables
from league.registry.database import insert
from league.registry.manifest import Manifest
from league.registry.registry import Registry
from league.registry.rows import RunState
from league.registry.snapshots import SUMMARY
from league.results.admission import admit
from league.results.ledger import Ledger, row
from league.results.records import Game, Match, Schedule
from league.settings import Storage

CONFIG = LeagueConfig.load(Path(__file__).parent.parent / "configs" / "connect_four.yaml")
CONFIG = CONFIG.model_copy(
    update={
        "gate": CONFIG.gate.model_copy(
            update={"elo1": 60, "max_blocks": 400, "nights": None, "earlier_champions": 0, "confirmation_blocks": 0}
        )
    }
)
"""Nights of some hundred blocks, and nothing that would have to be played."""
LEAGUE = CONFIG.league
READ_MS = 50.0
"""The target of a read."""
NEIGHBOURS = 10
"""Versions before it that a new one is rated against."""
LAST = 40
"""Versions that have all met: a whole payoff table."""
TOLD = 600
"""Points of a training run."""


def crowd(home: Path, versions: int = 200, matches: int = 100_000) -> Registry:
    """A registry in `home` with such a league, its snapshots up to date."""
    registry = Registry.open(Storage.at(home))
    registry.register(CONFIG, interface(CONFIG))
    _Crowd(registry, versions, matches).live()
    refresh(registry, LEAGUE)
    return registry


class _Crowd:
    """One night for each version, the last one tonight."""

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

    def live(self) -> None:
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

            return self._registry.publish(LEAGUE, build, source=f"crowd/{number}", parent=parent)

        return publish

    def _night(self, number: int) -> None:
        """A verdict, and a gauntlet of as many matches as there are left for this night."""
        league, new = self._registry.league(LEAGUE), f"{LEAGUE}@{number}"
        champion = self._registry.aliases(LEAGUE).get("champion")
        verdict = open_verdict(
            self._registry, league, number, f"{LEAGUE}@{champion}" if champion else "script:random", alpha=0.05
        )
        drawn = list(self._drawn(self._ledger.schedule(verdict.schedule), CONFIG.gate.max_blocks))
        self._write(drawn[: judge(gate_of(verdict), drawn, new).blocks], number, hour=1)
        conclude(self._registry, verdict)
        self._date(verdict.id, number)
        opponents = [f"{LEAGUE}@{n}" for n in range(max(1, number - NEIGHBOURS), number)]
        opponents += ["script:random", "script:one_ply"]
        left = self._matches * 0.96 * number / self._versions - self._written
        schedule = gauntlet(CONFIG, league.interface, [new], opponents, max(1, round(left / len(opponents))))
        self._write(list(self._drawn(self._ledger.open(schedule), schedule.length)), number, hour=3)

    def _round_robin(self) -> None:
        """What is left of the matches, between the last versions."""
        last = [f"{LEAGUE}@{n}" for n in range(max(1, self._versions - LAST + 1), self._versions + 1)]
        pairs = len(last) * (len(last) - 1) // 2
        blocks = max(1, -(-(self._matches - self._written) // pairs))
        schedule = round_robin(CONFIG, self._registry.league(LEAGUE).interface, last, blocks)
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
        rows = [row(match) | {"played_at": began + timedelta(seconds=number)} for number, match in enumerate(matches)]
        with self._registry.database.write() as session:
            self._written += insert(session, tables.Match, rows)

    def _date(self, verdict: str, night: int) -> None:
        """Verdict and promotion were that night, not just now."""
        opened, closed = self._evening(night) + timedelta(hours=1), self._evening(night) + timedelta(hours=2)
        with self._registry.database.write() as session:
            of_verdict = tables.Verdict.id == verdict
            session.execute(update(tables.Verdict).where(of_verdict).values(opened_at=opened, closed_at=closed))
            session.execute(update(tables.AliasEvent).where(tables.AliasEvent.verdict == verdict).values(at=closed))

    def _evening(self, night: int) -> datetime:
        return self._began + timedelta(days=night - 1)

    def _run(self, number: int, state: RunState) -> None:
        name = f"{self._evening(number + 1):%Y%m%d-%H%M%S}-{number:06x}"
        self._registry.begin_run(
            LEAGUE,
            name,
            algorithm=CONFIG.training.algorithm,
            settings=CONFIG.training.model_dump(mode="json", by_alias=True),
            seed=number,
            target=CONFIG.training.steps,
            parent=number or None,
        )
        walk = np.cumsum(self._rng.normal(0.002, 0.02, (TOLD, len(CURVES))), axis=0)
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
        newest = {"steps": points[-1]["steps"], "curves": points[-1]["curves"], "seconds": 10.0 * TOLD}
        with self._registry.database.write() as session:
            insert(session, tables.RunPoint, points)
            session.execute(update(tables.Run).where(tables.Run.id == name).values(began_at=began, **newest))
        if state != "running":
            self._registry.end_run(LEAGUE, name, state, "the power was cut" if state == "failed" else None)


RUNS: tuple[RunState, ...] = ("ended", "failed", "stopped", "ended", "running")
CURVES = (
    *("return", "length", "steps_per_second", "shared/return", "shared/length", "shared/entropy"),
    *("shared/policy_loss", "shared/value_loss", "shared/kl", "shared/gradient_norm"),
)


class _Pool:
    """Blocks that were played, by their results: (1.0, 0.0) if contestant 0 won the first game and lost the second."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self._blocks: defaultdict[tuple[float, ...], list[tuple[Game, ...]]] = defaultdict(list)
        with tempfile.TemporaryDirectory() as scratch:
            registry = Registry.open(Storage.at(Path(scratch)))
            registry.register(CONFIG, interface(CONFIG))
            evaluate(
                LEAGUE,
                ["script:random"],
                registry=registry,
                schedule="gauntlet",
                against=["script:one_ply"],
                blocks=600,
            )
            for match in Ledger(registry).matches(league=LEAGUE):
                for games in (match.games, _turned(match.games)):
                    self._blocks[tuple(game.scores[0] or 0.0 for game in games)].append(games)
            registry.close()

    def match(self, schedule: Schedule, position: int, results: tuple[float, ...]) -> Match:
        """The record of a match with these results."""
        known, seed = self._blocks[results], schedule.seed_at(position)
        games = known[self._rng.integers(len(known))]
        return schedule.match(position, [replace(game, seed=seed) for game in games])


def _turned(games: Sequence[Game]) -> tuple[Game, ...]:
    """The same block with its contestants named the other way round."""
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
    """Print what it takes to make such a league, to compute its snapshots, and to read; 1 if a target was missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="20 versions and 5,000 matches: shows that it works")
    return run(parser.parse_args(argv).quick)


def run(quick: bool = False) -> int:
    """The benchmark with its usual settings."""
    versions, matches = (20, 5_000) if quick else (200, 100_000)
    with tempfile.TemporaryDirectory() as scratch:
        began = time.perf_counter()
        registry = crowd(Path(scratch), versions, matches)
        seconds, size = time.perf_counter() - began, (Path(scratch) / "league.db").stat().st_size
        print(f"{versions} versions, {matches:,} matches: made in {seconds:.0f} s, {size / 1e6:.0f} MB", flush=True)
        _tell_snapshots(registry)
        met = _tell_reads(registry)
        registry.close()
    return int(not met)


def _tell_snapshots(registry: Registry) -> None:
    """As the studio has them computed: by a process of its own at the lowest priority, its start included."""
    print("\nsnapshots | seconds | memory")
    storage = registry.storage
    os.environ |= {"LEAGUE_HOME": str(storage.home), "LEAGUE_DATABASE_URL": storage.database_url}
    stale: dict[str, Executable] = {
        "after one match more": update(tables.Snapshot).where(tables.Snapshot.part == SUMMARY).values(mark=""),
        "from nothing": delete(tables.Snapshot),
    }
    for what, change in stale.items():
        with registry.database.write() as session:
            session.execute(change)
        began = time.perf_counter()
        process, peak = children.start("evaluation.snapshots", LEAGUE), 0
        while process.poll() is None:
            peak = max(peak, _memory(process.pid))
            time.sleep(0.01)
        assert children.bury(process) == 0
        print(f"{what} | {time.perf_counter() - began:.1f} | {peak / 1024:.0f} MB", flush=True)
    assert registry.stale_snapshots() == []


def _memory(process: int) -> int:
    """The most that a process has held so far, in KiB; 0 when it has ended."""
    found = re.search(r"^VmHWM:\s*(\d+) kB", Path(f"/proc/{process}/status").read_text(), re.M)
    return int(found[1]) if found else 0


def _tell_reads(registry: Registry) -> bool:
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
        told = "met" if middle <= READ_MS else f"MISSED (≤ {READ_MS:g})"
        print(f"{what} | {middle:.1f} | {slowest:.1f} | {told}", flush=True)
    return met


def _reads(registry: Registry) -> dict[str, Callable[[], object]]:
    ledger = Ledger(registry)
    newest = ledger.page(LEAGUE, limit=50)
    pair = newest[-1].result.contestants[0], newest[-1].result.contestants[1]
    old = f"{ledger.schedules(LEAGUE)[0].id}/0"
    verdict, (training, *_) = registry.newest_verdicts(LEAGUE, limit=1)[0].id, registry.runs(LEAGUE)
    return {
        "the newest 50 matches": lambda: ledger.page(LEAGUE, limit=50),
        "50 matches from the middle": lambda: ledger.page(LEAGUE, before=newest[-1].id, limit=50),
        "the oldest matches": lambda: ledger.page(LEAGUE, before=old, limit=50),
        "50 matches of two": lambda: ledger.page(LEAGUE, contestants=pair, limit=50),
        "no match of two": lambda: ledger.page(LEAGUE, contestants=("script:random", "script:first")),
        "a match with its moves": lambda: (ledger.match(newest[0].id), ledger.entry(newest[0].id)),
        "50 versions": lambda: registry.newest_versions(LEAGUE, limit=50),
        "50 verdicts": lambda: registry.newest_verdicts(LEAGUE, limit=50),
        "the last verdict of each league": registry.last_verdicts,
        "the champion's history": lambda: registry.history(LEAGUE, limit=50),
        "summaries of all leagues": lambda: registry.snapshots(SUMMARY),
        "standings": lambda: registry.snapshot(LEAGUE, "standings"),
        "the payoff table": lambda: registry.snapshot(LEAGUE, "payoff"),
        "ratings": lambda: registry.snapshot(LEAGUE, "ratings"),
        "a verdict with its curve": lambda: registry.snapshot(LEAGUE, f"verdict/{verdict}"),
        "training runs": lambda: registry.runs(LEAGUE),
        "a training run's points": lambda: registry.run_points(LEAGUE, training.id),
        "whether anything is new": registry.marks,
    }


if __name__ == "__main__":
    sys.exit(main())
