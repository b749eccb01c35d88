"""Lists results of a league: matches from the ledger, the leaderboard, the payoff matrix and the rating history.

    GET  /v1/leagues/{league}/matches                          newest first; ?limit= &before=
                                                               ?first= &second=: only those between these two
    GET  /v1/leagues/{league}/matches/{schedule}/{position}    with its games
    GET  /v1/leagues/{league}/leaderboard    ?side= &limit= &offset= &game=
    GET  /v1/leagues/{league}/payoff         ?game=
    GET  /v1/leagues/{league}/ratings

`game` names earlier conditions (`summary.earlier` of the league): results from before the game of the league, or the
selection of actions, changed. `computed_at` is the time of the last update, null before the first.
"""

from typing import Any

from starlette.requests import Request
from starlette.responses import Response

from league.conditions import Conditions
from league.errors import InvalidInput, UnknownMatch
from league.refs import check_slug
from league.registry.registry import Registry
from league.registry.snapshots import SUMMARY, earlier_part
from league.results.ledger import Ledger
from league.results.records import Game, LedgerEntry, Match, Schedule
from serve_app.models.resolver import ModelResolver
from serve_app.routes import parsing


class ResultRoutes:
    """The endpoints."""

    def __init__(self, models: ModelResolver) -> None:
        self._models = models

    async def matches(self, request: Request) -> Response:
        """A page of a league's matches. Raises UnknownLeague or InvalidInput."""
        league = check_slug("league", request.path_params["league"])
        limit, before = parsing.page_size(request), parsing.query_name(request, "before")
        pair = _pair(request)

        def query(registry: Registry) -> dict[str, Any]:
            rows = Ledger(registry).page(league, contestants=pair, before=before, limit=limit + 1)
            page, more = parsing.paginate(rows, limit, lambda row: row.id)
            current = registry.leagues.get(league).conditions
            return {"league": league, "matches": [_listed(entry, current) for entry in page], "next": more}

        return await parsing.query_response(self._models, query)

    async def match(self, request: Request) -> Response:
        """A match with its games. Raises UnknownLeague or UnknownMatch."""
        league = check_slug("league", request.path_params["league"])
        schedule, position = (parsing.path_name(request, key, UnknownMatch) for key in ("schedule", "position"))
        return await parsing.query_response(
            self._models, lambda registry: _one(registry, league, f"{schedule}/{position}")
        )

    async def leaderboard(self, request: Request) -> Response:
        """A page of the leaderboard, over all games or one side. Raises UnknownLeague or InvalidInput."""
        league = check_slug("league", request.path_params["league"])
        side, limit = parsing.query_name(request, "side"), parsing.page_size(request)
        offset = parsing.query_number(request, "offset", smallest=0) or 0
        game = parsing.query_name(request, "game")
        return await parsing.query_response(
            self._models, lambda registry: _leaderboard(registry, league, game, side, offset, limit)
        )

    async def payoff(self, request: Request) -> Response:
        """The payoff matrix of the best contestants. Raises UnknownLeague or InvalidInput."""
        league = check_slug("league", request.path_params["league"])
        game = parsing.query_name(request, "game")

        def query(registry: Registry) -> dict[str, Any]:
            document, computed_at = _snapshot(registry, league, _part(registry, league, game, "payoff"))
            return {"league": league, "computed_at": computed_at, "payoff": document}

        return await parsing.query_response(self._models, query)

    async def ratings(self, request: Request) -> Response:
        """The versions, oldest first, with their ratings and promotions. Raises UnknownLeague."""
        league = check_slug("league", request.path_params["league"])

        def query(registry: Registry) -> dict[str, Any]:
            document, computed_at = _snapshot(registry, league, "ratings")
            return {"league": league, "computed_at": computed_at} | (document or {"versions": []})

        return await parsing.query_response(self._models, query)


def _pair(request: Request) -> tuple[str, str] | None:
    first, second = parsing.query_name(request, "first"), parsing.query_name(request, "second")
    if first is None and second is None:
        return None
    if first is None or second is None:
        raise InvalidInput("first and second must be given together")
    return first, second


def _listed(entry: LedgerEntry, current: Conditions) -> dict[str, Any]:
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
        "counts": not entry.is_purged and entry.conditions == current,
        "played_at": entry.played_at.isoformat(),
    }


def _one(registry: Registry, league: str, name: str) -> dict[str, Any]:
    ledger = Ledger(registry)
    current = registry.leagues.get(league).conditions
    entry = ledger.entry(name)
    schedule, match = ledger.scheduled_match(name)
    if match.league != league:
        raise UnknownMatch(f"league {league} has no match {name!r}")
    games = [_game(number, game, match, schedule) for number, game in enumerate(match.games)]
    return {"league": league} | _listed(entry, current) | {"seed": match.seed, "games": games}


def _game(number: int, game: Game, match: Match, schedule: Schedule) -> dict[str, Any]:
    who = match.contestants
    return {
        "game": number,
        "sides": {side: who[contestant] for side, contestant in zip(schedule.sides, game.sides, strict=True)},
        "members": {ref: member for ref, member in zip(who, match.acting(number), strict=True) if ref != member},
        "scores": list(game.scores),
        "returns": list(game.returns),
        "opening": len(game.opening),
        "actions": len(game.actions),
        "forfeits": [
            {"ref": who[forfeit.contestant], "agent": forfeit.agent, "reason": forfeit.reason}
            for forfeit in game.forfeits
        ],
    }


def _part(registry: Registry, league: str, game: str | None, part: str) -> str:
    """Name of the snapshot of current results, or of results of an earlier game."""
    if game is None:
        return part
    summary, _ = _snapshot(registry, league, SUMMARY)
    games = [earlier_game["name"] for earlier_game in (summary or {}).get("earlier", ())]
    if game not in games:
        expected = f"game must be one of {', '.join(games)}" if games else f"{league} has no results of an earlier game"
        raise InvalidInput(f"{expected}, got {game!r}")
    return earlier_part(game, part)


def _leaderboard(
    registry: Registry, league: str, game: str | None, side: str | None, offset: int, limit: int
) -> dict[str, Any]:
    document, computed_at = _snapshot(registry, league, _part(registry, league, game, "leaderboard"))
    document = document or {"leaderboard": [], "by_side": {}}
    sides = list(document["by_side"])
    if side is not None and side not in sides:
        expected = (
            f"side must be one of {', '.join(sides)}" if sides else f"no side of {league} has its own leaderboard"
        )
        raise InvalidInput(f"{expected}, got {side!r}")
    every = document["leaderboard"] if side is None else document["by_side"][side]
    page = [{"rank": offset + place} | standing for place, standing in enumerate(every[offset : offset + limit], 1)]
    return {
        "league": league,
        "computed_at": computed_at,
        "sides": sides,
        "side": side,
        "leaderboard": page,
        "not_champion": document.get("not_champion"),
        "total": len(every),
    }


def _snapshot(registry: Registry, league: str, part: str) -> tuple[Any, str | None]:
    """A snapshot and its time; None before it was computed. Raises UnknownLeague."""
    snapshot = registry.snapshots.get(league, part)
    return (None, None) if snapshot is None else (snapshot.document, snapshot.at.isoformat())
