"""Compares two training runs: settings, budget, speed, curves, versions, and the games between their last versions."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from evaluation.documents import Document
from evaluation.statistics.payoff import score_interval
from league.errors import InvalidInput
from league.registry.registry import Registry
from league.registry.storage.rows import RunRow
from league.results.ledger import Ledger
from league.results.sums import outcomes, whole


@dataclass(frozen=True, slots=True)
class ComparedRun(Document):
    """One of two runs.

    seconds: training time. actions_per_second: steps of all agents per second of training; None before the first one.
    versions: references of the published versions, ascending.
    """

    league: str
    run: str
    algorithm: str
    state: str
    seed: int
    parent: str | None
    steps: int
    seconds: float
    actions_per_second: float | None
    versions: tuple[str, ...]
    began_at: datetime


@dataclass(frozen=True, slots=True)
class ScoreBetween(Document):
    """Mean score of the first run's last version against the second's, with its 95 % interval."""

    first: str
    second: str
    score: float
    interval: tuple[float, float]
    games: int


@dataclass(frozen=True, slots=True)
class RunComparison(Document):
    """Two runs side by side.

    settings: name → the values of both runs, of the settings that differ; None where a run has no such setting.
    curves: name → the last values of both runs.
    between: games of the two last versions, if the ledger has any that count.
    """

    runs: tuple[ComparedRun, ComparedRun]
    settings: dict[str, tuple[Any, Any]]
    curves: dict[str, tuple[float | None, float | None]]
    between: ScoreBetween | None


def compare_runs(registry: Registry, first: str, second: str) -> RunComparison:
    """Compare two runs.

    Args:
        registry: The registry.
        first: Id of a run or its unique beginning, also as `LEAGUE/RUN`.
        second: The same of the other run.

    Raises:
        UnknownRun: There is no such run.
        InvalidReference: Several ids begin so.
        InvalidInput: Both are the same run.
    """
    rows = registry.runs.find(first), registry.runs.find(second)
    if (rows[0].league, rows[0].id) == (rows[1].league, rows[1].id):
        raise InvalidInput(f"{first} and {second} are the same run, {rows[0].league}/{rows[0].id}: name two runs")
    runs = _compared(registry, rows[0]), _compared(registry, rows[1])
    settings = [dict(_flat(row.settings)) for row in rows]
    values = {name: (settings[0].get(name), settings[1].get(name)) for name in settings[0] | settings[1]}
    curves = {name: (rows[0].curves.get(name), rows[1].curves.get(name)) for name in rows[0].curves | rows[1].curves}
    differing = {name: pair for name, pair in values.items() if pair[0] != pair[1]}
    return RunComparison(runs, differing, dict(sorted(curves.items())), _between(registry, *runs))


def _compared(registry: Registry, row: RunRow) -> ComparedRun:
    published = [
        version.ref for version in registry.versions.all(row.league) if version.source.partition("/")[0] == row.id
    ]
    return ComparedRun(
        league=row.league,
        run=row.id,
        algorithm=row.algorithm,
        state=row.state,
        seed=row.seed,
        parent=None if row.parent is None else f"{row.league}@{row.parent}",
        steps=row.steps,
        seconds=row.seconds,
        actions_per_second=row.steps / row.seconds if row.seconds else None,
        versions=tuple(published),
        began_at=row.began_at,
    )


def _flat(settings: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Settings with names such as `opponents.league.share`."""
    for name, value in settings.items():
        if isinstance(value, Mapping) and value:
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def _between(registry: Registry, first: ComparedRun, second: ComparedRun) -> ScoreBetween | None:
    """The counted games of the last versions, which must be of one league."""
    if first.league != second.league or not (first.versions and second.versions):
        return None
    pair = first.versions[-1], second.versions[-1]
    conditions = registry.leagues.get(first.league).conditions
    ledger = Ledger(registry)
    sums = ledger.sums(first.league, ledger.counted(first.league, conditions), between=pair)
    if not sums or pair[0] == pair[1]:
        return None
    blocks = list(outcomes(whole(sums)))
    place = blocks[0].contestants.index(pair[0])
    scores = [score for block in blocks for score in [block.scores[place] / block.games] * block.matches]
    mean, low, high = score_interval(scores)
    return ScoreBetween(*pair, mean, (low, high), sum(block.games * block.matches for block in blocks))
