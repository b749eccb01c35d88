"""Lists training runs with their progress and the learning curves of each policy.

GET  /v1/leagues/{league}/runs          newest first; ?limit= &before=
GET  /v1/leagues/{league}/runs/{run}    with settings, curves, and the strength of its versions
"""

from typing import Any

from starlette.requests import Request
from starlette.responses import Response

from league.errors import UnknownRun
from league.refs import check_slug
from league.registry.registry import Registry
from league.registry.storage.rows import RunPoint, RunRow, StrengthRow
from serve_app.models.resolver import ModelResolver
from serve_app.routes import parsing


class RunRoutes:
    """The endpoints."""

    def __init__(self, models: ModelResolver) -> None:
        self._models = models

    async def page(self, request: Request) -> Response:
        """A page of a league's training runs. Raises UnknownLeague or InvalidInput."""
        league = check_slug("league", request.path_params["league"])
        limit, before = parsing.page_size(request), parsing.query_name(request, "before")

        def query(registry: Registry) -> dict[str, Any]:
            rows = registry.runs.newest(league, before=before, limit=limit + 1)
            page, more = parsing.paginate(rows, limit, lambda row: row.id)
            return {"league": league, "runs": list(map(_listed, page)), "next": more}

        return await parsing.query_response(self._models, query)

    async def get(self, request: Request) -> Response:
        """A training run. Raises UnknownLeague or UnknownRun."""
        league = check_slug("league", request.path_params["league"])
        run = parsing.path_name(request, "run", UnknownRun)

        def query(registry: Registry) -> dict[str, Any]:
            row, points = registry.runs.get(league, run), registry.runs.points(league, run)
            strength = list(map(_strength, registry.strength.of_run(league, run)))
            details = {"settings": row.settings, "points": list(map(_point, points)), "strength": strength}
            return {"league": league} | _listed(row) | details

        return await parsing.query_response(self._models, query)


def _listed(row: RunRow) -> dict[str, Any]:
    return {
        "run": row.id,
        "algorithm": row.algorithm,
        "state": row.state,
        "error": row.error,
        "steps": row.steps,
        "target": row.target,
        "minutes": row.settings.get("minutes"),
        "seconds": row.seconds,
        "seed": row.seed,
        "parent": row.parent,
        "role": row.role,
        "exploits": row.exploits,
        "attempts": row.attempts,
        "curves": row.curves,
        "began_at": row.began_at.isoformat(),
        "heartbeat_at": row.heartbeat_at.isoformat(),
        "ended_at": row.ended_at and row.ended_at.isoformat(),
    }


def _point(point: RunPoint) -> dict[str, Any]:
    return {"steps": point.steps, "at": point.at.isoformat(), "curves": point.curves}


def _strength(row: StrengthRow) -> dict[str, Any]:
    return {
        "version": row.version,
        "steps": row.steps,
        "opponent": row.opponent,
        "games": row.games,
        "score": row.score,
        "low": row.low,
        "high": row.high,
        "at": row.at.isoformat(),
    }
