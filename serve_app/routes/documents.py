"""Models of JSON documents that several routes take or return."""

from datetime import datetime
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from league.conditions import ActionSelection
from league.refs import MAX_VERSION
from league.registry.storage.manifest import SearchRule
from league.registry.storage.rows import EvaluationState, VerdictRow
from serve_app.declaration import NUMBER_OR_ALIAS, Response

OPEN = "open"

Number = Annotated[int, Field(ge=1, le=MAX_VERSION, description="The number of a version.")]
Aliases = dict[str, Number]
Interval = Annotated[
    tuple[float | None, float | None] | None, Field(description="95 % interval; an infinite bound is null.")
]
ComputedAt = Annotated[
    datetime | None,
    Field(description="When the evaluation service computed this; null before the first computation."),
]
StoredTime = Annotated[str, Field(json_schema_extra={"format": "date-time"})]
"""A time in a document that another process has computed."""
Selection = Annotated[
    ActionSelection,
    Field(
        description="How versions select actions in matches, and by default in requests. Versions without an action"
        " distribution are always greedy."
    ),
]


class StoredDocument(Response):
    """A document that another process has computed, and to which it may add fields."""

    model_config = ConfigDict(extra="allow")


class Error(Response):
    """An error."""

    model_config = ConfigDict(extra="allow")

    code: str = Field(description="Stable error code.")
    message: str = Field(description="Human-readable message.")


class MixtureMember(Response):
    """A version of a mixture, and its probability. The probabilities of a mixture sum to 1."""

    version: Number
    probability: float = Field(gt=0, le=1)


class VersionSearch(Response):
    """The search of a version that plays another one."""

    version: Number = Field(description="The version that evaluates positions.")
    rule: SearchRule
    simulations: int = Field(description="Positions that each decision evaluates besides the current one.")
    ms: float = Field(
        description="Milliseconds of a search from the initial position, on the machine that published the version."
    )


class EvaluationProgress(StoredDocument):
    """The progress of the games of a schedule."""

    what: str
    played: int = Field(description="Number of completed matches.")
    of: int = Field(description="Maximum number of matches.")
    moves_per_second: float | None = Field(
        default=None, description="Actions of all games per second, since this process started this schedule."
    )
    llr: float | None = Field(default=None, description="For a verdict: the current value of its test.")
    bounds: tuple[float, float] | None = None


class EvaluationSummary(Response):
    """An evaluation without its result."""

    league: str
    evaluation: int = Field(validation_alias="id")
    state: EvaluationState
    request: dict[str, Any] = Field(description="The request, with aliases replaced by versions.")
    progress: EvaluationProgress | None
    error: Error | None = Field(description="The reason for a failure.")
    actor: str = Field(description="The key that started the evaluation.")
    reason: str | None
    workers: int | None = Field(description="Number of worker processes.")
    stopped_by: str | None = Field(description="The key that stopped the evaluation.")
    created_at: datetime
    started_at: datetime | None
    heartbeat_at: datetime | None = Field(description="The last heartbeat of its process.")
    ended_at: datetime | None


class Evaluation(EvaluationSummary):
    """An evaluation."""

    result: dict[str, Any] | None = Field(description="The report of the evaluation.")


class VerdictDecision(Response):
    """What a verdict decided."""

    verdict: str
    candidate: str
    opponent: str
    outcome: Literal["open", "promote", "reject", "inconclusive", "void"]
    promoted: bool = Field(description="Whether the candidate became champion.")
    opened_at: datetime
    closed_at: datetime | None


class Share(Response):
    """A version, and its share of requests."""

    version: Number | Annotated[str, Field(json_schema_extra=NUMBER_OR_ALIAS)] = Field(
        description="The number of a version, or an alias."
    )
    share: float = Field(ge=0, le=1)


class TrafficSetting(Response):
    """A setting of canary and shadow."""

    league: str
    setting: int | None = Field(validation_alias="id")
    canary: Share | None
    shadow: Share | None
    actor: str | None
    reason: str | None
    at: datetime | None


class ChangeBody(BaseModel):
    """A change of what is served."""

    model_config = ConfigDict(extra="forbid", strict=True)

    reason: str = Field(
        default="over HTTP",
        min_length=1,
        max_length=2000,
        pattern=r"^[^\x00]+$",
        description="Recorded in the history.",
    )


def decision(row: VerdictRow) -> dict[str, Any]:
    """The fields of a VerdictDecision."""
    return {
        "verdict": row.id,
        "candidate": row.candidate_ref,
        "opponent": row.champion,
        "outcome": row.outcome or OPEN,
        "promoted": bool((row.evidence or {}).get("promoted")),
        "opened_at": row.opened_at,
        "closed_at": row.closed_at,
    }
