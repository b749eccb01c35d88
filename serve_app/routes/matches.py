"""The ledger: which matches were played, and how each game of one came out.

GET  /v1/leagues/{league}/matches                          newest first; ?limit= &before=
                                                           ?first= &second=: only those between these two
GET  /v1/leagues/{league}/matches/{schedule}/{position}    with its games
"""

from typing import Any

from starlette.requests import Request
from starlette.responses import Response

from league.errors import InvalidInput, UnknownMatch
from league.refs import check_slug
from league.registry.registry import Registry
from league.results.ledger import Ledger
from league.results.records import Entry, Game, Match, Schedule
from serve_app import queries
from serve_app.lookups import looked_up
from serve_app.models import Models


class MatchRoutes:
    """The endpoints."""

    def __init__(self, models: Models) -> None:
        self._models = models

    async def every(self, request: Request) -> Response:
        """A page of a league's matches. Raises UnknownLeague or InvalidInput."""
        league = check_slug("league", request.path_params["league"])
        limit, before = queries.limit(request), queries.name(request, "before")
        pair = _pair(request)

        def question(registry: Registry) -> dict[str, Any]:
            rows = Ledger(registry).page(league, contestants=pair, before=before, limit=limit + 1)
            page, more = queries.paged(rows, limit, lambda row: row.id)
            return {"league": league, "matches": list(map(_listed, page)), "next": more}

        return await looked_up(self._models, question)

    async def one(self, request: Request) -> Response:
        """One match with its games. Raises UnknownLeague or UnknownMatch."""
        league = check_slug("league", request.path_params["league"])
        schedule, position = (queries.named(request, key, UnknownMatch) for key in ("schedule", "position"))
        return await looked_up(self._models, lambda registry: _one(registry, league, f"{schedule}/{position}"))


def _pair(request: Request) -> tuple[str, str] | None:
    first, second = queries.name(request, "first"), queries.name(request, "second")
    if first is None and second is None:
        return None
    if first is None or second is None:
        raise InvalidInput("first and second go together: the two whose matches are asked for")
    return first, second


def _listed(entry: Entry) -> dict[str, Any]:
    result = entry.result
    return {
        "match": entry.id,
        "schedule": result.schedule,
        "position": result.position,
        "kind": entry.kind,
        "contestants": list(result.contestants),
        "scores": list(result.scores),
        "returns": result.returns and list(result.returns),
        "games": result.games,
        "counts": not entry.is_purged,
        "played_at": entry.played_at.isoformat(),
    }


def _one(registry: Registry, league: str, name: str) -> dict[str, Any]:
    ledger = Ledger(registry)
    registry.league(league)
    entry = ledger.entry(name)
    schedule, match = ledger.scheduled_match(name)
    if match.league != league:
        raise UnknownMatch(f"league {league} has no match {name!r}")
    games = [_game(number, game, match, schedule) for number, game in enumerate(match.games)]
    return {"league": league} | _listed(entry) | {"seed": match.seed, "games": games}


def _game(number: int, game: Game, match: Match, schedule: Schedule) -> dict[str, Any]:
    who = match.contestants
    return {
        "game": number,
        "sides": {side: who[contestant] for side, contestant in zip(schedule.sides, game.sides, strict=True)},
        "scores": list(game.scores),
        "returns": list(game.returns),
        "opening": len(game.opening),
        "actions": len(game.actions),
        "forfeits": [
            {"ref": who[forfeit.contestant], "agent": forfeit.agent, "reason": forfeit.reason}
            for forfeit in game.forfeits
        ],
    }
