"""Lists training runs with their progress, the learning curves of each policy, and the strength of their versions."""

from collections.abc import Sequence
from datetime import datetime
from typing import Annotated, Any, Literal

from pydantic import AliasPath, Field

from league.errors import UnknownRun
from league.registry.registry import Registry
from league.registry.storage.rows import RunRow, RunState
from serve_app.declaration import Declaration, Page, Response

Curves = Annotated[
    dict[str, float | None], Field(description="Value by metric; metrics of a policy are named `policy/metric`.")
]


class ListedRun(Response):
    """A training run."""

    run: str = Field(validation_alias="id")
    algorithm: str
    state: RunState = Field(
        description="`silent`: the run has not ended, but its last heartbeat was more than a minute ago."
    )
    error: str | None
    steps: int
    target: int | None = Field(description="The step budget. Null if only the time is limited.")
    minutes: float | None = Field(
        default=None,
        validation_alias=AliasPath("settings", "minutes"),
        description="The time budget in minutes. The run ends when either budget is used up.",
    )
    seconds: float = Field(description="Training time so far.")
    seed: int
    parent: int | None = Field(description="The version from which training was continued.")
    role: Literal["main", "exploiter"] = Field(description="The role of its versions.")
    exploits: str | None = Field(description="The version that an exploiter is trained against.")
    attempts: int = Field(description="How often the run was started or resumed.")
    curves: Curves
    began_at: datetime
    heartbeat_at: datetime
    ended_at: datetime | None


class Point(Response):
    """The values of curves at a step."""

    steps: int
    at: datetime
    curves: Curves


class Strength(Response):
    """The score of a version in the matches that its training run played against an opponent."""

    version: int
    steps: int = Field(description="Actions of the run before the version, with those of its parent versions.")
    opponent: str = Field(description="A fixed reference.")
    games: int
    score: float
    low: float = Field(description="Lower bound of the 95 % interval.")
    high: float = Field(description="Upper bound of the 95 % interval.")
    at: datetime


class Run(ListedRun):
    """A training run with its settings, its curves and the strength of its versions."""

    league: str
    settings: dict[str, Any] = Field(description="The settings of the algorithm.")
    points: list[Point] = Field(description="Ordered by steps, at most a few hundred.")
    strength: list[Strength] = Field(
        description="The scores of its versions against the opponents of `training.strength`, oldest version first."
    )


@Declaration(
    "GET",
    "/v1/leagues/{league}/runs",
    Page("runs", ListedRun, "run"),
    scope="read",
    tag="Results",
    success="A page of training runs.",
)
def runs(registry: Registry, league: str, limit: int, before: str | None) -> Sequence[RunRow]:
    """List training runs.

    Newest first.
    """
    return registry.runs.newest(league, before=before, limit=limit)


@Declaration("GET", "/v1/leagues/{league}/runs/{run}", Run, scope="read", tag="Results", errors=(UnknownRun,))
def run(registry: Registry, league: str, run: str) -> dict[str, Any]:
    """Get a training run with its metrics."""
    row, points = registry.runs.get(league, run), registry.runs.points(league, run)
    details = {"points": points, "strength": registry.strength.of_run(league, run)}
    # The time budget is read from the settings again: given by both names, it would be refused.
    listed = ListedRun.model_validate(row).model_dump(exclude={"minutes"})
    return listed | {"league": league, "settings": row.settings} | details
