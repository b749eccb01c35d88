"""Shows recorded games, and plays games of people against policies, with the evaluation service.

    GET   /v1/leagues/{league}/matches/{schedule}/{position}/games/{game}            its steps: ?from=0&to=100&every=1
    GET   /v1/leagues/{league}/matches/{schedule}/{position}/games/{game}/video.gif
    GET   /v1/leagues/{league}/playable                                              playable agents and opponents
    POST  /v1/leagues/{league}/play {"opponent": "connect_four@champion", "agent": "player_0", "actions": [3]}

The server keeps no state of a person's game: each request contains the seed and all actions.
"""

from collections.abc import Callable

from starlette.requests import Request
from starlette.responses import Response

from league.errors import UnknownMatch
from league.policies.loading import requested
from league.refs import check_slug
from league.registry.registry import Registry
from league.results.ledger import Ledger
from league.service_requests import (
    GameOperation,
    GameRequest,
    GameResponse,
    HumanPlayRequest,
    PlayabilityRequest,
    PlayBody,
    RecordingRequest,
    VideoRequest,
)
from serve_app.access.request_body import MAX_CHANGE_BODY, read_body
from serve_app.evaluation_client import EvaluationClient, require_client
from serve_app.models.resolver import ModelResolver
from serve_app.routes import parsing

DIGITS = 10
"""Exclusive maximum of digits in the number of a game."""


class GameRoutes:
    """The endpoints."""

    def __init__(self, models: ModelResolver, evaluation_client: EvaluationClient | None) -> None:
        self._models = models
        self._evaluation_client = evaluation_client

    async def recording(self, request: Request) -> Response:
        """Steps of a recorded game. Raises UnknownLeague, UnknownMatch, InvalidInput, and the errors of the evaluation
        service.
        """
        match, game = _named(request)
        first, end = (parsing.query_number(request, name, smallest=0) for name in ("from", "to"))
        every = parsing.query_number(request, "every")
        operation = RecordingRequest(match=match, game=game, first=first or 0, end=end, every=every or 1)
        return _response(await self._of_match(request, match, game, operation))

    async def video(self, request: Request) -> Response:
        """A recorded game as a GIF to download. Raises the errors of `recording`."""
        match, game = _named(request)
        video = await self._of_match(request, match, game, VideoRequest(match=match, game=game))
        name = f"{match.replace('/', '-')}-{game}.gif"
        return _response(video, {"content-disposition": f'attachment; filename="{name}"'})

    async def playability(self, request: Request) -> Response:
        """Whether and how a league can be played. Raises UnknownLeague and the errors of the evaluation service."""
        return _response(await self._request_game(request, lambda *_: PlayabilityRequest()))

    async def play(self, request: Request) -> Response:
        """A person's game up to the next choice.

        Raises InvalidInput, InvalidReference, UnknownLeague, UnknownVersion, UnknownAlias, UnknownPolicy,
        EnvironmentMismatch, IllegalAction, and the errors of the evaluation service.
        """
        body = parsing.parse_body(PlayBody, await read_body(request.scope, request.receive, MAX_CHANGE_BODY))

        def build_operation(registry: Registry, league: str) -> HumanPlayRequest:
            return HumanPlayRequest(**body.model_dump() | {"opponent": requested(body.opponent, league, registry)})

        return _response(await self._request_game(request, build_operation))

    async def _of_match(
        self, request: Request, match: str, game: int, operation: RecordingRequest | VideoRequest
    ) -> GameResponse:
        def check(registry: Registry, league: str) -> RecordingRequest | VideoRequest:
            record = Ledger(registry).match(match)
            if record.league != league or game >= len(record.games):
                raise UnknownMatch(f"league {league} has no game {game} of match {match}")
            return operation

        return await self._request_game(request, check)

    async def _request_game(
        self, request: Request, build_operation: Callable[[Registry, str], GameOperation]
    ) -> GameResponse:
        """Build an operation with the registry and send it to the evaluation service."""
        league = check_slug("league", request.path_params["league"])

        def build_request(registry: Registry) -> GameRequest:
            return GameRequest(
                league=league,
                conditions=registry.leagues.get(league).conditions.name,
                operation=build_operation(registry, league),
            )

        game_request = await self._models.query(build_request)
        return await require_client(self._evaluation_client).request_game(game_request)


def _response(game: GameResponse, headers: dict[str, str] | None = None) -> Response:
    return Response(game.content, headers=headers, media_type=game.media_type)


def _named(request: Request) -> tuple[str, int]:
    """The match and the game in a path. Raises UnknownMatch."""
    schedule, position, game = (
        parsing.path_name(request, key, UnknownMatch) for key in ("schedule", "position", "game")
    )
    match = f"{schedule}/{position}"
    if not (game.isascii() and game.isdigit() and len(game) < DIGITS):
        raise UnknownMatch(f"match {match} has no game {game[:32]!r}: expected a number")
    return match, int(game)
