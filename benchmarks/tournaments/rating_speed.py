"""How long does it take to rate 1,000 versions from a million games?

Three leagues, with blocks of two games drawn from the logistic model:

- nights: each version has played `script:random`, the ten previous versions and some older ones, in 500 blocks;
- adaptive: each version has played those of similar strength;
- round robin: each pair has played once, 499,500 pairs.

Measured is `evaluation.matches.leaderboard.rank_contestants`: ratings and their 95 % intervals, from sums in memory. In
addition, the sums of the round robin are read from a ledger, a SQLite file. Target: 10 s each.
"""

import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
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
from league.results.sums import Pair, PairSums, pair_of, whole
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
        sums = _sums(pairs, truth, rng)
        yield _rated(name, pairs, lambda sums=sums: sums)
    if not quick:
        with tempfile.TemporaryDirectory() as scratch:
            registry = _written(Path(scratch), sums)
            ledger = Ledger(registry)
            schedules = ledger.schedules(LEAGUE)
            yield _rated("round robin from its ledger", pairs, lambda: ledger.sums(LEAGUE, schedules))
            registry.close()


def _rated(name: str, pairs: Pairs, read: Callable[[], dict[Pair, PairSums]]) -> Target:
    began = time.perf_counter()
    table = rank_contestants(whole(read()))
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


def _sums(pairs: Pairs, truth: NDArray[np.float64], rng: np.random.Generator) -> dict[Pair, PairSums]:
    won = rng.binomial(2, expit(truth[pairs[:, 0]] - truth[pairs[:, 1]])).tolist()
    sums: defaultdict[Pair, PairSums] = defaultdict(PairSums)
    for (i, j), wins in zip(pairs.tolist(), won, strict=True):
        names = _name(i), _name(j)
        pair = pair_of(names)
        points = wins if pair == names else 2 - wins
        sums[pair].matches += 1
        sums[pair].whole.count((2 * points, 4 - 2 * points), 2, (2 * points - 2, 2 - 2 * points), 1)
    return dict(sums)


def _written(scratch: Path, sums: Mapping[Pair, PairSums]) -> Registry:
    """A ledger with the sums of a round robin, without its matches, as they are not read."""
    config = LeagueConfig.from_mapping(
        {"league": LEAGUE, "environment": {"entry_point": "pettingzoo.classic.tictactoe_v3"}}
    )
    registry = Registry.open(Storage.at(scratch / "home"))
    registry.leagues.register(config, interface(config))
    contestants = list(dict.fromkeys(ref for pair in sums for ref in pair))
    schedule = Ledger(registry).open(round_robin(config, interface(config), contestants, blocks=1))
    rows = [
        {"schedule": schedule.id, "league": LEAGUE, "first": first, "second": second, "sums": of_pair.dump()}
        for (first, second), of_pair in sums.items()
    ]
    for start in range(0, len(rows), BATCH):
        with registry.database.write() as session:
            insert(session, tables.PairSumTable, [row | {"examples": "[]"} for row in rows[start : start + BATCH]])
    return registry
