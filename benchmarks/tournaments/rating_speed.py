"""How long does it take to rate 1,000 versions from a million games?

Three leagues, with blocks of two games drawn from the logistic model:

- nights: each version has played `script:random`, the ten previous versions and some older ones, in 500 blocks;
- adaptive: each version has played those of similar strength;
- round robin: each pair has played once, 499,500 pairs.

Measured is `evaluation.matches.leaderboard.ranked`: sums, ratings, and their 95 % intervals, from blocks in memory. In
addition, the round robin is written to a ledger, a SQLite file, and measured again from there. Target: 10 s each.
"""

import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from benchmarks.harness import Target
from evaluation.matches.leaderboard import rank_contestants
from evaluation.schedules.builders import round_robin
from league.config.league import LeagueConfig
from league.environments.building import interface
from league.registry.registry import Registry
from league.registry.storage import tables
from league.registry.storage.database import insert
from league.results.ledger import Ledger
from league.results.records import BlockResult, Game, dump_games, dump_numbers
from league.settings import Storage

SECONDS = 10.0
"""The target in seconds."""
LEAGUE = "tictactoe"
BATCH = 20_000

Pairs = NDArray[np.int64]


def run(quick: bool) -> Iterator[Target]:
    """Rate the leagues; quick: 200 versions, without a ledger."""
    versions, rng = 200 if quick else 1000, np.random.default_rng(0)
    truth = np.cumsum(rng.normal(2, 6, versions)) * np.log(10) / 400
    for name, draw in LEAGUES.items():
        pairs = draw(versions, truth, rng)
        results = _blocks(pairs, truth, rng)
        yield _rated(name, pairs, lambda results=results: results)
    if not quick:
        with tempfile.TemporaryDirectory() as scratch:
            registry = _written(Path(scratch), results)
            yield _rated("round robin from its ledger", pairs, lambda: Ledger(registry).results(LEAGUE))
            registry.close()


def _rated(name: str, pairs: Pairs, read: Callable[[], list[BlockResult]]) -> Target:
    began = time.perf_counter()
    table = rank_contestants(read())
    seconds = time.perf_counter() - began
    assert all(standing.interval is not None for standing in table)
    note = f"{2 * len(pairs):,} games of {len(np.unique(np.sort(pairs, axis=1), axis=0)):,} pairs"
    return Target(f"ratings of {name}", round(seconds, 1), "s", at_most=SECONDS, note=note)


def _nights(versions: int, truth: NDArray[np.float64], rng: np.random.Generator) -> Pairs:  # noqa: ARG001
    version = np.repeat(np.arange(1, versions), 500)
    kind = rng.random(len(version))
    distance = rng.integers(1, 11, len(version))
    older = (rng.integers(0, 20, len(version)) * version) // 20
    opponent = np.where(kind < 0.1, 0, np.where(kind < 0.9, np.maximum(version - distance, 0), older))
    return np.column_stack([version, opponent])


def _adaptive(versions: int, truth: NDArray[np.float64], rng: np.random.Generator) -> Pairs:
    rank = rng.integers(0, versions, 500 * versions)
    other = np.clip(rank + rng.integers(1, 20, len(rank)) * rng.choice([-1, 1], len(rank)), 0, versions - 1)
    return np.argsort(truth)[np.column_stack([rank, other])[rank != other]]


def _round_robin(versions: int, truth: NDArray[np.float64], rng: np.random.Generator) -> Pairs:  # noqa: ARG001
    return np.column_stack(np.triu_indices(versions, 1))


LEAGUES = {"nights": _nights, "adaptive": _adaptive, "round robin": _round_robin}


def _name(version: int) -> str:
    return f"{LEAGUE}@{version}" if version else "script:random"


def _blocks(pairs: Pairs, truth: NDArray[np.float64], rng: np.random.Generator) -> list[BlockResult]:
    won = rng.binomial(2, expit(truth[pairs[:, 0]] - truth[pairs[:, 1]])).tolist()
    return [
        BlockResult(
            "schedule", at, (_name(i), _name(j)), 2, (float(points), 2.0 - points), (2.0 * points - 2, 2 - 2.0 * points)
        )
        for at, ((i, j), points) in enumerate(zip(pairs.tolist(), won, strict=True))
    ]


def _written(scratch: Path, results: Sequence[BlockResult]) -> Registry:
    """A ledger with a round robin of these results; most moves are omitted, as they are not read."""
    config = LeagueConfig.from_mapping(
        {"league": LEAGUE, "environment": {"entry_point": "pettingzoo.classic.tictactoe_v3"}}
    )
    registry = Registry.open(Storage.at(scratch / "home"))
    registry.leagues.register(config, interface(config))
    contestants = list(dict.fromkeys(ref for block in results for ref in block.contestants))
    schedule = Ledger(registry).open(round_robin(config, interface(config), contestants, blocks=1))
    moves = dump_games([Game((i, 1 - i), 1, (), (4, 0, 8), (1.0, -1.0), (1.0, 0.0)) for i in range(2)])
    for start in range(0, len(results), BATCH):
        rows = [
            {
                "schedule": schedule.id,
                "position": block.position,
                "league": LEAGUE,
                "first": block.contestants[0],
                "second": block.contestants[1],
                "games": block.games,
                "scores": dump_numbers(block.scores),
                "returns": dump_numbers(block.returns),
                "moves": moves,
                "played_at": datetime.now(UTC),
            }
            for block in results[start : start + BATCH]
        ]
        with registry.database.write() as session:
            insert(session, tables.MatchTable, rows)
    return registry
