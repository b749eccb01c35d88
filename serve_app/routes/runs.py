"""Training runs, as their drivers tell of them: how far they are, and the curves of each policy.

GET  /v1/leagues/{league}/runs          newest first; ?limit= &before=
GET  /v1/leagues/{league}/runs/{run}    with settings and curves
"""

from typing import Any

from starlette.requests import Request
from starlette.responses import Response

from league.errors import UnknownRun
from league.refs import check_slug
from league.registry.registry import Registry
from league.registry.rows import RunPoint, RunRow
from serve_app import queries
from serve_app.lookups import looked_up
from serve_app.models import Models


class RunRoutes:
    """The endpoints."""

    def __init__(self, models: Models) -> None:
        self._models = models

    async def every(self, request: Request) -> Response:
        """A page of a league's training runs. Raises UnknownLeague or InvalidInput."""
        league = check_slug("league", request.path_params["league"])
        limit, before = queries.limit(request), queries.name(request, "before")

        def question(registry: Registry) -> dict[str, Any]:
            rows = registry.runs(league, before=before, limit=limit + 1)
            page, more = queries.paged(rows, limit, lambda row: row.id)
            return {"league": league, "runs": list(map(_listed, page)), "next": more}

        return await looked_up(self._models, question)

    async def one(self, request: Request) -> Response:
        """One training run. Raises UnknownLeague or UnknownRun."""
        league = check_slug("league", request.path_params["league"])
        run = queries.named(request, "run", UnknownRun)

        def question(registry: Registry) -> dict[str, Any]:
            row, points = registry.run(league, run), registry.run_points(league, run)
            return {"league": league} | _listed(row) | {"settings": row.settings, "points": list(map(_point, points))}

        return await looked_up(self._models, question)


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
        "lives": row.lives,
        "curves": row.curves,
        "began_at": row.began_at.isoformat(),
        "heartbeat_at": row.heartbeat_at.isoformat(),
        "ended_at": row.ended_at and row.ended_at.isoformat(),
    }


def _point(point: RunPoint) -> dict[str, Any]:
    return {"steps": point.steps, "at": point.at.isoformat(), "curves": point.curves}
