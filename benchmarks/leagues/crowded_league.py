"""A league of connect four after 200 nightly runs: 200 versions and 100,000 matches, verdicts, promotions and training
runs.

Results are drawn from the logistic model with strengths that increase with each version. The games are real games of
`script:random` against `script:one_ply`, selected by their result, so that they can be replayed. All versions have the
same policy with random weights.
"""

from __future__ import annotations

import tempfile
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
from sqlalchemy import bindparam, update

from benchmarks.harness import CONFIGS
from benchmarks.leagues.served_league import builder
from evaluation.gating.gate import SequentialTest, decide_matches
from evaluation.gating.verdicts import conclude, open_verdict
from evaluation.matches.tournament import evaluate
from evaluation.schedules.builders import gauntlet, round_robin
from evaluation.service.snapshots import refresh
from league.config.league import LeagueConfig
from league.environments.building import interface
from league.registry.registry import Registry
from league.registry.storage import rows, tables
from league.registry.storage.database import insert
from league.registry.storage.manifest import Manifest
from league.registry.storage.rows import RunState
from league.results.ledger import Ledger
from league.results.records import Game, Match, Schedule
from league.settings import Storage

CONFIG = LeagueConfig.load(CONFIGS / "connect_four.yaml")
CONFIG = CONFIG.model_copy(
    update={
        "gate": CONFIG.gate.model_copy(
            update={"elo1": 60, "max_blocks": 400, "nights": None, "earlier_champions": 0, "confirmation_blocks": 0}
        )
    }
)
"""Nightly runs of some hundred blocks, without anything that requires real games."""
LEAGUE = CONFIG.league
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
        self._write(drawn[: decide_matches(SequentialTest(verdict.gate, new), drawn).blocks], number, hour=1)
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
        self._written += self._ledger.extend(matches)
        began, table = self._evening(night) + timedelta(hours=hour), tables.MatchTable
        dated = [{"at": began + timedelta(seconds=match.position), "place": match.position} for match in matches]
        query = update(table.__table__).where(table.schedule == matches[0].schedule)  # type: ignore[arg-type]
        with self._registry.database.write() as session:
            session.connection().execute(
                query.where(table.position == bindparam("place")).values(played_at=bindparam("at")), dated
            )

    def _date(self, verdict: str, night: int) -> None:
        """Set the dates of a verdict and its promotion to that night."""
        opened, closed = self._evening(night) + timedelta(hours=1), self._evening(night) + timedelta(hours=2)
        with self._registry.database.write() as session:
            of_verdict = rows.VerdictRow.id == verdict
            session.execute(update(rows.VerdictRow).where(of_verdict).values(opened_at=opened, closed_at=closed))
            session.execute(update(rows.AliasEvent).where(rows.AliasEvent.verdict == verdict).values(at=closed))

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
            insert(session, rows.RunPoint, points)
            session.execute(update(rows.RunRow).where(rows.RunRow.id == name).values(began_at=began, **newest))
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
        games_of_result, seed = self._blocks[results], schedule.seed_at(position)
        games = games_of_result[self._rng.integers(len(games_of_result))]
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
