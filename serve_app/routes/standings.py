"""What a league's games say, as the studio has computed it last: who stands where, who beats whom, how ratings went.

GET  /v1/leagues/{league}/standings    ?side= &limit= &offset=
GET  /v1/leagues/{league}/payoff
GET  /v1/leagues/{league}/ratings

`computed_at` tells when; it is null where nothing was computed yet.
"""

from typing import Any

from starlette.requests import Request
from starlette.responses import Response

from league.errors import InvalidInput
from league.refs import check_slug
from league.registry.registry import Registry
from serve_app import queries
from serve_app.lookups import looked_up
from serve_app.models import Models


class StandingsRoutes:
    """The endpoints."""

    def __init__(self, models: Models) -> None:
        self._models = models

    async def standings(self, request: Request) -> Response:
        """A page of the leaderboard, over all games or on one side. Raises UnknownLeague or InvalidInput."""
        league = check_slug("league", request.path_params["league"])
        side, limit = queries.name(request, "side"), queries.limit(request)
        offset = queries.number(request, "offset", smallest=0) or 0
        return await looked_up(self._models, lambda registry: _standings(registry, league, side, offset, limit))

    async def payoff(self, request: Request) -> Response:
        """Who beats whom, of the best contestants. Raises UnknownLeague."""
        league = check_slug("league", request.path_params["league"])

        def question(registry: Registry) -> dict[str, Any]:
            document, computed_at = _part(registry, league, "payoff")
            return {"league": league, "computed_at": computed_at, "payoff": document}

        return await looked_up(self._models, question)

    async def ratings(self, request: Request) -> Response:
        """The versions, oldest first, with their ratings and promotions. Raises UnknownLeague."""
        league = check_slug("league", request.path_params["league"])

        def question(registry: Registry) -> dict[str, Any]:
            document, computed_at = _part(registry, league, "ratings")
            return {"league": league, "computed_at": computed_at} | (document or {"versions": []})

        return await looked_up(self._models, question)


def _standings(registry: Registry, league: str, side: str | None, offset: int, limit: int) -> dict[str, Any]:
    document, computed_at = _part(registry, league, "standings")
    document = document or {"standings": [], "by_side": {}}
    sides = list(document["by_side"])
    if side is not None and side not in sides:
        known = f"side must be one of {', '.join(sides)}" if sides else f"no side of {league} has standings of its own"
        raise InvalidInput(f"{known}, got {side!r}")
    every = document["standings"] if side is None else document["by_side"][side]
    page = [{"rank": offset + place} | standing for place, standing in enumerate(every[offset : offset + limit], 1)]
    return {
        "league": league,
        "computed_at": computed_at,
        "sides": sides,
        "side": side,
        "standings": page,
        "total": len(every),
    }


def _part(registry: Registry, league: str, part: str) -> tuple[Any, str | None]:
    """A document, and when it was computed; nothing where it was not. Raises UnknownLeague."""
    found = registry.snapshot(league, part)
    return (None, None) if found is None else (found.document, found.at.isoformat())
