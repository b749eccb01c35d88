"""Verdicts: what a gate has decided, or is deciding, and on which evidence.

GET  /v1/leagues/{league}/verdicts              newest first; ?limit= &before=
GET  /v1/leagues/{league}/verdicts/{verdict}    with the test's curve, and all that was last computed of it
"""

from typing import Any

from starlette.requests import Request
from starlette.responses import Response

from league.errors import UnknownVerdict
from league.refs import check_slug
from league.registry.registry import Registry
from league.registry.rows import VerdictRow
from serve_app import queries
from serve_app.lookups import looked_up
from serve_app.models import Models

OPEN = "open"
SHOWN = ("llr", "bounds", "blocks", "games", "score", "elo", "interval")
"""Of the evidence, in lists. A verdict that is open has none."""


class VerdictRoutes:
    """The endpoints."""

    def __init__(self, models: Models) -> None:
        self._models = models

    async def every(self, request: Request) -> Response:
        """A page of a league's verdicts. Raises UnknownLeague or InvalidInput."""
        league = check_slug("league", request.path_params["league"])
        limit, before = queries.limit(request), queries.name(request, "before")

        def question(registry: Registry) -> dict[str, Any]:
            rows = registry.newest_verdicts(league, before=before, limit=limit + 1)
            page, more = queries.paged(rows, limit, lambda row: row.id)
            told = registry.verdict_reasons(league, [row.id for row in page])
            verdicts = [_listed(row) | {"reason": _reason(row, *told.get(row.id, (None, None)))} for row in page]
            return {"league": league, "verdicts": verdicts, "next": more}

        return await looked_up(self._models, question)

    async def one(self, request: Request) -> Response:
        """One verdict, all of it. Raises UnknownLeague or UnknownVerdict."""
        league = check_slug("league", request.path_params["league"])
        verdict = queries.named(request, "verdict", UnknownVerdict)
        return await looked_up(self._models, lambda registry: _one(registry, league, verdict))


def brief(row: VerdictRow) -> dict[str, Any]:
    """What was decided, as JSON."""
    return {
        "verdict": row.id,
        "candidate": f"{row.league}@{row.candidate}",
        "opponent": row.champion,
        "outcome": row.outcome or OPEN,
        "promoted": bool((row.evidence or {}).get("promoted")),
        "opened_at": row.opened_at.isoformat(),
        "closed_at": row.closed_at and row.closed_at.isoformat(),
    }


def _listed(row: VerdictRow) -> dict[str, Any]:
    evidence = row.evidence or {}
    return brief(row) | {name: evidence.get(name) for name in SHOWN}


def _one(registry: Registry, league: str, verdict: str) -> dict[str, Any]:
    found, row = registry.snapshot(league, f"verdict/{verdict}"), registry.verdict(verdict)
    if row.league != league:
        raise UnknownVerdict(f"league {league} has no verdict {verdict!r}")
    document = {"league": league, "reason": None, "computed_at": None} | _listed(row)
    if found is not None:
        judgement = found.document
        document |= {"computed_at": found.at.isoformat()} | judgement | brief(row)
        document["reason"] = _reason(row, judgement["outcome"], judgement["reason"])
    return document


def _reason(row: VerdictRow, outcome: str | None, reason: str | None) -> str | None:
    """What was computed while the outcome was another is no reason for this one."""
    return reason if outcome == (row.outcome or OPEN) else None
