"""Lists verdicts of the promotion gate, open and decided, with their evidence.

GET  /v1/leagues/{league}/verdicts              newest first; ?limit= &before=
GET  /v1/leagues/{league}/verdicts/{verdict}    with the curve of the test and all computed evidence

A verdict is named by its id, or by a unique beginning of its id or digest.
"""

from typing import Any

from starlette.requests import Request
from starlette.responses import Response

from league.errors import UnknownVerdict
from league.refs import check_slug
from league.registry.registry import Registry
from league.registry.storage.rows import VerdictRow
from league.results.ledger import Ledger
from serve_app.models.resolver import ModelResolver
from serve_app.routes import documents, parsing

SHOWN = ("llr", "bounds", "blocks", "games", "score", "elo", "interval")
"""Evidence in lists. An open verdict has none."""


class VerdictRoutes:
    """The endpoints."""

    def __init__(self, models: ModelResolver) -> None:
        self._models = models

    async def page(self, request: Request) -> Response:
        """A page of a league's verdicts. Raises UnknownLeague or InvalidInput."""
        league = check_slug("league", request.path_params["league"])
        limit, before = parsing.page_size(request), parsing.query_name(request, "before")

        def query(registry: Registry) -> dict[str, Any]:
            rows = registry.verdicts.newest(league, before=before, limit=limit + 1)
            page, more = parsing.paginate(rows, limit, lambda row: row.id)
            reasons = registry.snapshots.verdict_reasons(league, [row.id for row in page])
            verdicts = [_listed(row) | {"reason": _reason(row, *reasons.get(row.id, (None, None)))} for row in page]
            return {"league": league, "verdicts": verdicts, "next": more}

        return await parsing.query_response(self._models, query)

    async def get(self, request: Request) -> Response:
        """A verdict with all its evidence. Raises UnknownLeague, UnknownVerdict or InvalidReference."""
        league = check_slug("league", request.path_params["league"])
        verdict = parsing.path_name(request, "verdict", UnknownVerdict)
        return await parsing.query_response(self._models, lambda registry: _one(registry, league, verdict))


def _listed(row: VerdictRow) -> dict[str, Any]:
    evidence = row.evidence or {}
    return documents.verdict_summary(row) | {name: evidence.get(name) for name in SHOWN}


def _one(registry: Registry, league: str, verdict: str) -> dict[str, Any]:
    row = registry.verdicts.find(verdict, league)
    snapshot = registry.snapshots.get(league, f"verdict/{row.id}")
    conditions = Ledger(registry).schedule(row.schedule).conditions
    is_current = conditions == registry.leagues.get(league).conditions
    document = {"league": league, "reason": None, "computed_at": None} | _listed(row)
    document["earlier_game"] = None if is_current else conditions.name
    if snapshot is not None:
        judgement = snapshot.document
        document |= {"computed_at": snapshot.at.isoformat()} | judgement | documents.verdict_summary(row)
        document["reason"] = _reason(row, judgement["outcome"], judgement["reason"])
    return document


def _reason(row: VerdictRow, outcome: str | None, reason: str | None) -> str | None:
    """The reason, unless it was computed for an earlier outcome."""
    return reason if outcome == (row.outcome or documents.OPEN) else None
