"""Lists verdicts of the promotion gate, open and decided, with their evidence.

A verdict is named by its id, or by a unique beginning of its id or digest.
"""

from collections.abc import Sequence
from typing import Any

from pydantic import ConfigDict, Field

from league.errors import UnknownVerdict
from league.registry.registry import Registry
from league.registry.storage.rows import VerdictRow
from league.results.ledger import Ledger
from serve_app.declaration import Declaration, Page
from serve_app.routes import documents
from serve_app.routes.documents import ComputedAt, Interval, VerdictDecision

SHOWN = ("llr", "bounds", "blocks", "games", "score", "elo", "interval")
"""Evidence in lists. An open verdict has none."""


class ListedVerdict(VerdictDecision):
    """A verdict. Its evidence is null until it is computed."""

    reason: str | None = Field(
        description="What decided, and the scores of candidate and champion, in sentences; null before it is computed."
    )
    llr: float | None = Field(description="The log-likelihood ratio, or the log wealth of a betting test.")
    bounds: tuple[float, float] | None = Field(description="The decision bounds.")
    blocks: int | None = Field(description="Number of counted matches.")
    games: int | None
    score: float | None
    elo: float | None
    interval: Interval


class Verdict(ListedVerdict):
    """A verdict with its evidence. Once computed, it has all fields of a verdict in `league report --json`."""

    model_config = ConfigDict(extra="allow")

    league: str
    computed_at: ComputedAt
    remedy: str | None = Field(
        default=None,
        description="What would have to change for a promotion, in sentences; null after one, and while the verdict is"
        " open.",
    )
    earlier_game: str | None = Field(
        description="Where the results of its games are, if the league had another game then: the `game` of leaderboard"
        " and payoffs. Null: its games count today."
    )
    curve: list[tuple[float, float]] = Field(default=[], description="[block, LLR] pairs, at most a few hundred.")


@Declaration(
    "GET", "/v1/leagues/{league}/verdicts", Page("verdicts", ListedVerdict, "verdict"), scope="read", tag="Results"
)
def verdicts(registry: Registry, league: str, limit: int, before: str | None) -> Sequence[dict[str, Any]]:
    """List verdicts.

    Newest first, including open verdicts.
    """
    rows = registry.verdicts.newest(league, before=before, limit=limit)
    reasons = registry.snapshots.verdict_reasons(league, [row.id for row in rows])
    return [_listed(row) | {"reason": _reason(row, *reasons.get(row.id, (None, None)))} for row in rows]


@Declaration(
    "GET",
    "/v1/leagues/{league}/verdicts/{verdict}",
    Verdict,
    scope="read",
    tag="Results",
    errors=(UnknownVerdict,),
)
def verdict(registry: Registry, league: str, verdict: str) -> dict[str, Any]:
    """Get a verdict with its evidence.

    By its id or a unique beginning of its digest. Includes the curve of the test, `[block, LLR]`, once the evaluation
    service has computed it (`computed_at`).
    """
    row = registry.verdicts.find(verdict, league)
    snapshot = registry.snapshots.get(league, f"verdict/{row.id}")
    conditions = Ledger(registry).schedule(row.schedule).conditions
    is_current = conditions == registry.leagues.get(league).conditions
    document = {"league": league, "reason": None, "computed_at": None} | _listed(row)
    document["earlier_game"] = None if is_current else conditions.name
    if snapshot is not None:
        judgement = snapshot.document
        document |= {"computed_at": snapshot.at} | judgement | documents.decision(row)
        document["reason"] = _reason(row, judgement["outcome"], judgement["reason"])
    return document


def _listed(row: VerdictRow) -> dict[str, Any]:
    evidence = row.evidence or {}
    return documents.decision(row) | {name: evidence.get(name) for name in SHOWN}


def _reason(row: VerdictRow, outcome: str | None, reason: str | None) -> str | None:
    """The reason, unless it was computed for an earlier outcome."""
    return reason if outcome == (row.outcome or documents.OPEN) else None
