"""The history of an alias: who pointed it where, when and why; and which version it was then.

GET  /v1/leagues/{league}/aliases/{alias}/history    newest first; ?limit= &before=
                                                     ?at=2026-03-03T14:00:00Z: only the movement in force then
"""

from typing import Any

from starlette.requests import Request
from starlette.responses import Response

from league.errors import InvalidInput
from league.refs import check_alias, check_slug
from league.registry.registry import Registry
from serve_app import queries
from serve_app.lookups import looked_up
from serve_app.models import Models
from serve_app.routes.promotion import event_document


class HistoryRoutes:
    """The endpoint."""

    def __init__(self, models: Models) -> None:
        self._models = models

    async def history(self, request: Request) -> Response:
        """A page of an alias's movements, none if there never was one. Raises UnknownLeague or InvalidInput."""
        league = check_slug("league", request.path_params["league"])
        alias = check_alias(request.path_params["alias"])
        limit, before = queries.limit(request), queries.number(request, "before")
        at = queries.instant(request, "at")
        if at is not None and before is not None:
            raise InvalidInput("at and before contradict each other: one movement, or a page of them")

        def question(registry: Registry) -> dict[str, Any]:
            rows = registry.history(league, alias, at, before=before, limit=limit + 1)
            page, more = queries.paged(rows, limit, lambda row: row.id)
            return {"league": league, "alias": alias, "history": list(map(event_document, page)), "next": more}

        return await looked_up(self._models, question)
