"""Shows recorded games, and plays games of people against policies, with the evaluation service.

The server keeps no state of a person's game: each request contains the seed and all actions.
"""

from collections.abc import Callable

from starlette.requests import Request
from starlette.responses import Response

from league.errors import (
    EnvironmentMismatch,
    GameCrashed,
    GameHung,
    IllegalAction,
    InvalidInput,
    NoEvaluationService,
    RemoteError,
    UnknownAlias,
    UnknownMatch,
    UnknownPolicy,
    UnknownVersion,
    VersionRetired,
    WorkerLost,
)
from league.policies.loading import requested
from league.refs import CheckpointRef
from league.registry.registry import Registry
from league.results.ledger import Ledger
from league.service_requests import (
    MOST_ANALYSED,
    MOST_NUMBER,
    GameOperation,
    GameRequest,
    GameResponse,
    HumanPlayRequest,
    Playability,
    PlayabilityRequest,
    PlayBody,
    PlayedGame,
    RecordedGame,
    RecordingRequest,
    VideoRequest,
)
from serve_app.declaration import Declaration, Parameter, integer
from serve_app.evaluation_client import EvaluationClient, require_client
from serve_app.live_versions.resolver import ModelResolver

GAME_PATH = "/v1/leagues/{league}/matches/{schedule}/{position}/games/{game}"
OF_GAMES = (NoEvaluationService, GameCrashed, WorkerLost, GameHung)


class GameRoutes:
    """The endpoints."""

    def __init__(self, models: ModelResolver, evaluation_client: EvaluationClient | None) -> None:
        self._models = models
        self._evaluation_client = evaluation_client

    @Declaration(
        "GET",
        GAME_PATH,
        RecordedGame,
        parameters=(
            integer(
                "from",
                "The first step. Step 0 is the initial state.",
                smallest=0,
                largest=MOST_NUMBER,
                default=0,
                argument="first",
            ),
            integer("to", "The end of the range (exclusive).", smallest=0, largest=MOST_NUMBER, argument="end"),
            integer("every", "The distance between two steps.", largest=MOST_NUMBER, default=1),
            integer(
                "analysis",
                "A search version that evaluates the positions: `chances` are its probabilities, and `value` is the"
                " return that it expects for the agent.",
                largest=MOST_NUMBER,
            ),
        ),
        errors=(UnknownMatch, UnknownVersion, VersionRetired, EnvironmentMismatch, *OF_GAMES),
        scope="read",
        tag="Games",
    )
    async def game(
        self,
        _: Request,
        league: str,
        schedule: str,
        position: str,
        game: int,
        first: int,
        end: int | None,
        every: int,
        analysis: int | None,
    ) -> Response:
        """Get the steps of a recorded game.

        The game is replayed from its seed and compared with the record. A response contains at most 100 steps: every
        `every`-th step from `from` (inclusive) to `to` (exclusive), and the last step of the game if it is in this
        range.
        """
        match = f"{schedule}/{position}"
        operation = RecordingRequest(match=match, game=game, first=first, end=end, every=every, analysis=analysis)
        return _response(await self._of_match(league, operation))

    @Declaration(
        "GET",
        f"{GAME_PATH}/video.gif",
        success="An animated GIF.",
        media=("image/gif",),
        headers=(Parameter("content-disposition", {"type": "string"}, "The file name."),),
        errors=(UnknownMatch, EnvironmentMismatch, *OF_GAMES),
        scope="read",
        tag="Games",
    )
    async def game_video(self, _: Request, league: str, schedule: str, position: str, game: int) -> Response:
        """Get a recorded game as an animated GIF.

        At most 500 frames. Each frame shows the actions and their probabilities.
        """
        video = await self._of_match(league, VideoRequest(match=f"{schedule}/{position}", game=game))
        name = f"{schedule}-{position}-{game}.gif".replace("/", "-")
        return _response(video, {"content-disposition": f'attachment; filename="{name}"'})

    @Declaration(
        "GET",
        "/v1/leagues/{league}/playable",
        Playability,
        errors=OF_GAMES,
        scope="read",
        tag="Games",
    )
    async def playable(self, _: Request, league: str) -> Response:
        """Get the available agents and opponents.

        People can play wherever agents choose one of several actions.
        """
        return _response(await self._request_game(league, lambda _: PlayabilityRequest()))

    @Declaration(
        "POST",
        "/v1/leagues/{league}/play",
        PlayedGame,
        body=PlayBody,
        errors=(
            UnknownVersion,
            VersionRetired,
            UnknownAlias,
            UnknownPolicy,
            EnvironmentMismatch,
            IllegalAction,
            RemoteError,
            *OF_GAMES,
        ),
        scope="act",
        tag="Games",
    )
    async def play(self, _: Request, league: str, body: PlayBody) -> Response:
        """Play against a version.

        Plays the game from its `seed` with your `actions` so far, up to your next turn. The opponent plays all other
        agents and selects actions as in the league's matches. The server keeps no state: send the seed and all actions
        with each call. The call can be repeated, and omitting the last actions undoes them.

        An alias is resolved when the call is made. Use the `opponent` of the first response in all following calls.
        """

        def build_operation(registry: Registry) -> HumanPlayRequest:
            _check_analysis(registry, league, body.analysis)
            return HumanPlayRequest(**body.model_dump() | {"opponent": requested(body.opponent, league, registry)})

        return _response(await self._request_game(league, build_operation))

    async def _of_match(self, league: str, operation: RecordingRequest | VideoRequest) -> GameResponse:
        """Send an operation on a recorded game to the evaluation service. Raises UnknownMatch."""

        def check(registry: Registry) -> RecordingRequest | VideoRequest:
            record = Ledger(registry).match(operation.match)
            if record.league != league or operation.game >= len(record.games):
                raise UnknownMatch(f"league {league} has no game {operation.game} of match {operation.match}")
            if isinstance(operation, RecordingRequest):
                _check_analysis(registry, league, operation.analysis)
            return operation

        return await self._request_game(league, check)

    async def _request_game(self, league: str, build_operation: Callable[[Registry], GameOperation]) -> GameResponse:
        """Build an operation with the registry and send it to the evaluation service."""

        def build_request(registry: Registry) -> GameRequest:
            conditions = registry.leagues.get(league).conditions.name
            return GameRequest(league=league, conditions=conditions, operation=build_operation(registry))

        game_request = await self._models.in_registry_thread(build_request)
        return await require_client(self._evaluation_client).request_game(game_request)


def _check_analysis(registry: Registry, league: str, number: int | None) -> None:
    """Raise UnknownVersion, VersionRetired, or InvalidInput unless the version has a search that is short enough."""
    if number is None:
        return
    search = registry.versions.with_files(CheckpointRef(league, number)).search
    if search is None:
        raise InvalidInput(f"analysis: {league}@{number} does not search: name a search version")
    if search.simulations > MOST_ANALYSED:
        raise InvalidInput(
            f"analysis: {league}@{number} has {search.simulations} simulations, expected at most {MOST_ANALYSED}"
        )


def _response(game: GameResponse, headers: dict[str, str] | None = None) -> Response:
    return Response(game.content, headers=headers, media_type=game.media_type)
