"""Games to look at, and to play: what needs an environment is asked of the studio, and goes on as it answers.

GET   /v1/leagues/{league}/matches/{schedule}/{position}/games/{game}            its steps: ?from=0&to=100&every=1
GET   /v1/leagues/{league}/matches/{schedule}/{position}/games/{game}/film.gif
GET   /v1/leagues/{league}/playable                                              as whom, and against whom
POST  /v1/leagues/{league}/play    {"opponent": "connect_four@champion", "agent": "player_0", "seed": 7, "actions": [3]}

Nothing of a game is kept for whoever plays it: seed and actions are the game, and come with each request.
"""

from collections.abc import Callable
from typing import Any

from starlette.requests import Request
from starlette.responses import Response

from league.errors import InvalidInput, NoStudio, NotFound, UnknownMatch
from league.games import Film, Order, Play, Recording, Sitting, Table
from league.policies.pinning import check_eligible, pinned
from league.refs import check_slug
from league.registry.registry import Registry
from league.results.ledger import Ledger
from serve_app.bodies import read_body
from serve_app.models import Models
from serve_app.routes.promotion import parse
from serve_app.settings import ServeSettings
from serve_app.studio import Answer, Studio

LARGEST = 2**31 - 1
NUMBER = 10
"""Digits of a position, a game, or a step."""


class GameRoutes:
    """The endpoints."""

    def __init__(self, models: Models, settings: ServeSettings, studio: Studio | None) -> None:
        self._models = models
        self._settings = settings
        self._studio = studio

    async def recording(self, request: Request) -> Response:
        """Steps of a recorded game. Raises UnknownLeague, UnknownMatch, InvalidInput, and what the studio does."""
        match, game = _named(request)
        query = {name: _number(request, name, least) for name, least in (("from", 0), ("to", 0), ("every", 1))}
        asked = Recording(match=match, game=game, first=query["from"] or 0, end=query["to"], every=query["every"] or 1)
        return _response(await self._of_match(request, match, game, asked))

    async def film(self, request: Request) -> Response:
        """A recorded game as a GIF, to be kept. Raises what `recording` does."""
        match, game = _named(request)
        answer = await self._of_match(request, match, game, Film(match=match, game=game))
        name = f"{match.replace('/', '-')}-{game}.gif"
        return _response(answer, {"content-disposition": f'attachment; filename="{name}"'})

    async def table(self, request: Request) -> Response:
        """Whether and how a league can be played. Raises UnknownLeague, and what the studio does."""
        return _response(await self._ask(request, lambda *_: Table()))

    async def play(self, request: Request) -> Response:
        """A person's game up to the next choice.

        Raises InvalidInput, InvalidReference, UnknownLeague, UnknownVersion, UnknownAlias, UnknownPolicy,
        EnvironmentMismatch, IllegalAction, and what the studio does.
        """
        body = parse(Play, await read_body(request.scope, request.receive, self._settings.max_body))

        def sitting(registry: Registry, league: str) -> Sitting:
            opponent = pinned(body.opponent, league, registry)
            check_eligible(opponent, registry, registry.league(league).config)
            return Sitting(**body.model_dump() | {"opponent": opponent})

        return _response(await self._ask(request, sitting))

    async def _of_match(self, request: Request, match: str, game: int, asked: Recording | Film) -> Answer:
        def check(registry: Registry, league: str) -> Recording | Film:
            try:
                record = Ledger(registry).match(match)
            except NotFound as error:
                raise UnknownMatch(f"league {league} has no match {match}: {error}") from None
            if record.league != league or game >= len(record.games):
                raise UnknownMatch(f"league {league} has no game {game} of match {match}")
            return asked

        return await self._ask(request, check)

    async def _ask(
        self, request: Request, question: Callable[[Registry, str], Recording | Film | Table | Sitting]
    ) -> Answer:
        """What the studio says to a question about the league of a request, which is made with the registry."""
        league = check_slug("league", request.path_params["league"])

        def order(registry: Registry) -> Order:
            return Order(
                league=league, environment=registry.league(league).environment_digest, asked=question(registry, league)
            )

        asked = await self._models.ask(order)
        if self._studio is None:
            raise NoStudio("this server plays no games: `studio` is not set in its deploy.yaml")
        return await self._studio.ask(asked)


def _response(answer: Answer, headers: dict[str, str] | None = None) -> Response:
    return Response(answer.content, headers=headers, media_type=answer.media_type)


def _named(request: Request) -> tuple[str, int]:
    """The match and the game that a path names. Raises UnknownMatch."""
    parts: dict[str, Any] = request.path_params
    match = f"{parts['schedule']}/{parts['position']}"
    if not (_is_number(parts["position"]) and _is_number(parts["game"])):
        raise UnknownMatch(f"there is no game {parts['game'][:32]!r} of match {match[:256]!r}: they are numbers")
    return match, int(parts["game"])


def _number(request: Request, name: str, least: int) -> int | None:
    """A number of the query. Raises InvalidInput."""
    text = request.query_params.get(name)
    if text is None:
        return None
    if not (_is_number(text) and int(text) >= least):
        raise InvalidInput(f"{name} must be a number from {least} to {LARGEST}, got {text[:32]!r}")
    return int(text)


def _is_number(text: str) -> bool:
    return text.isascii() and text.isdigit() and len(text) <= NUMBER and int(text) <= LARGEST
