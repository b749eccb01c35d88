"""Evaluations: games between a league's versions, played by the studio, followed and stopped from here.

POST    /v1/leagues/{league}/evaluations        {"contestants": ["connect_four@3", "script:one_ply"], "blocks": 64}
GET     /v1/leagues/{league}/evaluations        newest first; ?limit= &before=
GET     /v1/leagues/{league}/evaluations/{evaluation}
DELETE  /v1/leagues/{league}/evaluations/{evaluation}

What is asked is checked at once, written to the registry, and played by whoever runs the studio; any replica can tell
how far it is. Starting and stopping take a key of scope `evaluate`, a night of scope `promote` as well.
"""

from typing import Any

from starlette.requests import Request
from starlette.responses import JSONResponse

from league.errors import Forbidden, NoStudio, UnknownEvaluation
from league.evaluations import Asked, Night, Tournament
from league.policies.pinning import check_eligible, eligible, pinned
from league.refs import check_slug
from league.registry.registry import Registry
from league.registry.rows import EvaluationRow
from serve_app import queries
from serve_app.bodies import read_body
from serve_app.doors import KEY
from serve_app.keyring import Key
from serve_app.models import Models
from serve_app.routes.promotion import call_of, parse
from serve_app.settings import ServeSettings
from serve_app.studio import Studio

PAGE, LARGEST_PAGE = 20, 100


class EvaluationRoutes:
    """The endpoints. Doors lets only keys of scope `evaluate` start and stop."""

    def __init__(self, models: Models, settings: ServeSettings, studio: Studio | None) -> None:
        self._models = models
        self._settings = settings
        self._studio = studio

    async def start(self, request: Request) -> JSONResponse:
        """Queue an evaluation: 202.

        Raises NoStudio, InvalidInput, Forbidden, InvalidReference, UnknownLeague, UnknownVersion, UnknownAlias,
        UnknownPolicy, EnvironmentMismatch, TooManyEvaluations or KeyReused.
        """
        league = check_slug("league", request.path_params["league"])
        body = await read_body(request.scope, request.receive, self._settings.max_body)
        asked = parse(Asked, body or b"{}")
        key, call = call_of(request, asked)
        if isinstance(asked.root, Night) and "promote" not in key.scopes:
            raise Forbidden(f"a night may promote: this needs a key of scope promote as well, which {key.name} is not")
        if self._studio is None:
            raise NoStudio("this server plays no games: `studio` is not set in its deploy.yaml")

        def ask(registry: Registry) -> EvaluationRow:
            return registry.ask_evaluation(
                league,
                _pinned(asked, league, registry),
                actor=key.name,
                key=key.id,
                reason=asked.root.reason,
                most=self._settings.max_evaluations,
                call=call,
            )

        row = await self._models.ask(ask)
        self._studio.look()
        return JSONResponse(evaluation_document(row), 202, {"location": f"{request.url.path}/{row.id}"})

    async def every(self, request: Request) -> JSONResponse:
        """A page of a league's evaluations, without their results. Raises UnknownLeague or InvalidInput."""
        league = check_slug("league", request.path_params["league"])
        limit = queries.number(request, "limit", LARGEST_PAGE) or PAGE
        before = queries.number(request, "before")
        rows = await self._models.ask(lambda registry: registry.evaluations(league, before=before, limit=limit + 1))
        page, more = queries.paged(rows, limit, lambda row: row.id)
        documents = [_document(row) for row in page]
        return JSONResponse({"league": league, "evaluations": documents, "next": more})

    async def one(self, request: Request) -> JSONResponse:
        """One evaluation: how far it is, and what it has brought. Raises UnknownLeague or UnknownEvaluation."""
        league, number = named(request)
        return JSONResponse(
            evaluation_document(await self._models.ask(lambda registry: registry.evaluation(league, number)))
        )

    async def stop(self, request: Request) -> JSONResponse:
        """Ask for its end; what has ended stays as it is. Raises UnknownLeague or UnknownEvaluation."""
        league, number = named(request)
        key: Key = request.scope[KEY]
        row = await self._models.ask(lambda registry: registry.stop_evaluation(league, number, actor=key.name))
        if self._studio is not None:
            self._studio.look()
        return JSONResponse(evaluation_document(row))


def _pinned(asked: Asked, league: str, registry: Registry) -> dict[str, Any]:
    """What is kept: with versions that are the same when it is played, or played on after a fault."""
    row = registry.league(league)
    document = asked.root.model_dump(mode="json", exclude={"reason"})
    if isinstance(asked.root, Tournament):
        for name in ("contestants", "against"):
            document[name] = [pinned(ref, league, registry) for ref in getattr(asked.root, name)]
            for ref in document[name]:
                check_eligible(ref, registry, row.config)
        document["contestants"] = document["contestants"] or [version.ref for version in eligible(registry, league)]
    return document


def named(request: Request) -> tuple[str, int]:
    """The league and the number of an evaluation that a path names. Raises InvalidReference or UnknownEvaluation."""
    league, number = check_slug("league", request.path_params["league"]), request.path_params["evaluation"]
    if not (number.isascii() and number.isdigit() and len(number) <= 10 and int(number) <= queries.LARGEST):
        raise UnknownEvaluation(f"league {league} has no evaluation {number[:32]!r}: it is a number")
    return league, int(number)


def _document(row: EvaluationRow) -> dict[str, Any]:
    instants = {"created_at": row.created_at, "started_at": row.started_at, "ended_at": row.ended_at}
    return {
        "league": row.league,
        "evaluation": row.id,
        "state": row.state,
        "asked": row.asked,
        "progress": row.progress,
        "error": row.error,
        "actor": row.actor,
        "reason": row.reason,
        "workers": row.workers,
        "stopped_by": row.stopped_by,
        "heartbeat_at": row.heartbeat_at and row.heartbeat_at.isoformat(),
    } | {name: instant and instant.isoformat() for name, instant in instants.items()}


def evaluation_document(row: EvaluationRow) -> dict[str, Any]:
    """An evaluation as JSON, with its result."""
    return _document(row) | {"result": row.result}
