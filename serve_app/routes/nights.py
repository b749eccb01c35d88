"""Lists nights of training and nightly runs: the champion after each, how exploitable it is, and the verdicts."""

from collections.abc import Mapping, Sequence
from datetime import datetime
from typing import Any

from pydantic import Field

from league.registry.registry import Registry
from league.registry.storage.rows import NightlyRunRow, TrainingNightRow
from serve_app.declaration import Declaration, Page, Response
from serve_app.routes.documents import Interval

RATINGS = "ratings"
"""The snapshot with the ratings of all versions."""


class Gain(Response):
    """Mean return of the exploiter minus that of the champion, with a 95 % interval."""

    mean: float
    low: float | None
    high: float | None


class ChampionExploitability(Response):
    """The score of the best exploiter against the champion."""

    bound: float = Field(description="A best response scores at least this.")
    exploiter: str
    games: int
    score: float
    low: float
    high: float
    gain: Gain | None


class TrainingNight(Response):
    """A night of training. Results of steps that are not complete yet are null or empty."""

    training_night: int = Field(description="Its id, unique among all leagues.")
    number: int = Field(description="Its place among the nights of the league, from 1.")
    run: str = Field(description="Its training run.")
    exploiter_run: str | None = Field(description="The training run of the champion's exploiter.")
    parent: int | None = Field(
        description="The version that training started from, null: from scratch. Until training is complete, the"
        " champion when the night began, or the newest version."
    )
    versions: list[str] = Field(description="The versions that were trained.")
    champion_before: str | None
    champion: str | None = Field(description="The champion after the gate.")
    rating: float | None = Field(description="The champion's rating now, in Elo above `script:random`.")
    interval: Interval
    exploitability: ChampionExploitability | None
    errors: list[str]
    began_at: datetime
    ended_at: datetime | None


class NightlyVerdict(Response):
    """A verdict of a nightly run."""

    verdict: str
    candidate: str
    opponent: str
    outcome: str
    promoted: bool = Field(description="Whether the candidate became champion.")


class NightlyRun(Response):
    """A nightly run. What it decided is null or empty while it runs."""

    nightly_run: int = Field(description="Its id, unique among all leagues.")
    candidates: list[str] = Field(description="The versions that it tests.")
    alpha: float = Field(description="Error probability of each verdict.")
    verdicts: list[NightlyVerdict] = Field(description="Empty while it runs.")
    champion_before: str | None
    champion: str | None = Field(description="The champion after the run.")
    errors: list[str] = Field(description="Versions that could not be tested or rated.")
    began_at: datetime
    ended_at: datetime | None


@Declaration(
    "GET",
    "/v1/leagues/{league}/training-nights",
    Page("training_nights", TrainingNight, "training_night"),
    scope="read",
    tag="Results",
)
def training_nights(registry: Registry, league: str, limit: int, before: int | None) -> Sequence[TrainingNight]:
    """List nights of training.

    The nights of `league nightly --train`, newest first.
    """
    rows = [row for row in reversed(registry.training_nights.all(league)) if before is None or row.id < before]
    snapshot = registry.snapshots.get(league, RATINGS)
    ratings = {} if snapshot is None else {rating["ref"]: rating for rating in snapshot.document["versions"]}
    return [_training_night(row, ratings) for row in rows[:limit]]


@Declaration(
    "GET",
    "/v1/leagues/{league}/nightly-runs",
    Page("nightly_runs", NightlyRun, "nightly_run"),
    scope="read",
    tag="Results",
)
def nightly_runs(registry: Registry, league: str, limit: int, before: int | None) -> Sequence[NightlyRun]:
    """List nightly runs.

    The runs of `league nightly`, alone or in a night of training, newest first.
    """
    rows = [row for row in reversed(registry.nightly_runs.all(league)) if before is None or row.id < before]
    return [_nightly_run(row) for row in rows[:limit]]


def _nightly_run(row: NightlyRunRow) -> NightlyRun:
    report = row.report or {}
    return NightlyRun(
        nightly_run=row.id,
        candidates=[f"{row.league}@{number}" for number in row.candidates],
        alpha=row.alpha,
        verdicts=[
            NightlyVerdict(**{name: verdict[name] for name in NightlyVerdict.model_fields})
            for verdict in report.get("verdicts", ())
        ],
        champion_before=report.get("champion_before"),
        champion=report.get("champion"),
        errors=report.get("faults", []),
        began_at=row.began_at,
        ended_at=row.ended_at,
    )


def _training_night(row: TrainingNightRow, ratings: Mapping[str, Any]) -> TrainingNight:
    train, gate, measured = (row.steps.get(step, {}) for step in ("train", "gate", "measure"))
    champion = gate.get("champion")
    rated, exploitability = ratings.get(champion, {}), None
    if (score := measured.get("exploitability")) is not None:
        best = score["exploiters"][0]
        figures = {name: best[name] for name in ("games", "score", "low", "high", "gain")}
        exploitability = ChampionExploitability(bound=score["bound"], exploiter=best["ref"], **figures)
    return TrainingNight(
        training_night=row.id,
        number=row.number,
        run=row.run,
        exploiter_run=row.steps.get("exploiter", {}).get("run"),
        parent=row.start,
        versions=train.get("versions", []),
        champion_before=gate.get("champion_before"),
        champion=champion,
        rating=rated.get("rating"),
        interval=rated.get("interval"),
        exploitability=exploitability,
        errors=[f"{step}: {result['error']}" for step, result in row.steps.items() if "error" in result],
        began_at=row.began_at,
        ended_at=row.ended_at,
    )
