"""Games to look at, and to play: what needs an environment is asked of the studio, and goes on as it answers.

GET   /v1/leagues/{league}/matches/{schedule}/{position}/games/{game}            its steps: ?from=0&to=100&every=1
GET   /v1/leagues/{league}/matches/{schedule}/{position}/games/{game}/film.gif
GET   /v1/leagues/{league}/playable                                              as whom, and against whom
POST  /v1/leagues/{league}/play    {"opponent": "connect_four@champion", "agent": "player_0", "seed": 7, "actions": [3]}

Nothing of a game is kept for whoever plays it: seed and actions are the game, and come with each request.
"""

from collections.abc import Callable

from starlette.requests import Request
from starlette.responses import Response

from league.errors import NoStudio, UnknownMatch
from league.games import Film, Order, Play, Recording, Sitting, Table
from league.policies.pinning import check_eligible, pinned
from league.refs import check_slug
from league.registry.registry import Registry
from league.results.ledger import Ledger
from serve_app import queries
from serve_app.bodies import read_body
from serve_app.models import Models
from serve_app.routes.promotion import parse
from serve_app.settings import ServeSettings
from serve_app.studio import Answer, Studio

DIGITS = 10
"""No number of a game has as many."""


class GameRoutes:
    """The endpoints."""

    def __init__(self, models: Models, settings: ServeSettings, studio: Studio | None) -> None:
        self._models = models
        self._settings = settings
        self._studio = studio

    async def recording(self, request: Request) -> Response:
        """Steps of a recorded game. Raises UnknownLeague, UnknownMatch, InvalidInput, and what the studio does."""
        match, game = _named(request)
        first, end = (queries.number(request, name, smallest=0) for name in ("from", "to"))
        every = queries.number(request, "every")
        asked = Recording(match=match, game=game, first=first or 0, end=end, every=every or 1)
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
            record = Ledger(registry).match(match)
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
    schedule, position, game = (queries.named(request, key, UnknownMatch) for key in ("schedule", "position", "game"))
    match = f"{schedule}/{position}"
    if not (game.isascii() and game.isdigit() and len(game) < DIGITS):
        raise UnknownMatch(f"match {match} has no game {game[:32]!r}: it is a number")
    return match, int(game)
