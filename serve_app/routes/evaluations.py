"""Starts, lists and stops evaluations: games between versions of a league, played by the evaluation service.

    POST    /v1/leagues/{league}/evaluations        {"contestants": ["connect_four@3", "script:one_ply"], "blocks": 64}
    GET     /v1/leagues/{league}/evaluations        newest first; ?limit= &before=
    GET     /v1/leagues/{league}/evaluations/{evaluation}
    DELETE  /v1/leagues/{league}/evaluations/{evaluation}

A request is validated, written to the registry, and played by the evaluation service; any replica reports its progress.
Starting and stopping require a key of scope `evaluate`; a nightly run also requires the scope `promote`.
"""

from typing import Any

from starlette.requests import Request
from starlette.responses import JSONResponse

from league.errors import Forbidden
from league.policies.loading import eligible, requested
from league.refs import check_slug
from league.registry.registry import Registry
from league.registry.storage.rows import EvaluationRow
from league.service_requests import EvaluationRequest, NightlyRequest, TournamentRequest
from serve_app.access.access_control import DEADLINE, KEY
from serve_app.access.api_keys import ApiKey
from serve_app.access.request_body import MAX_CHANGE_BODY, read_body
from serve_app.evaluation_client import EvaluationClient, require_client
from serve_app.models.resolver import ModelResolver
from serve_app.routes import documents, parsing
from serve_app.settings import ServeSettings

PAGE, MAX_PAGE = 20, 100


class EvaluationRoutes:
    """The endpoints. Access control requires the scope `evaluate` for POST and DELETE."""

    def __init__(
        self, models: ModelResolver, settings: ServeSettings, evaluation_client: EvaluationClient | None
    ) -> None:
        self._models = models
        self._settings = settings
        self._evaluation_client = evaluation_client

    async def start(self, request: Request) -> JSONResponse:
        """Queue an evaluation, and respond with 202.

        Raises NoEvaluationService, InvalidInput, Forbidden, InvalidReference, UnknownLeague, UnknownVersion,
        UnknownAlias, UnknownPolicy, EnvironmentMismatch, TooManyEvaluations or KeyReused.
        """
        league = check_slug("league", request.path_params["league"])
        body = await read_body(request.scope, request.receive, MAX_CHANGE_BODY)
        evaluation_request = parsing.parse_body(EvaluationRequest, body or b"{}")
        key, call = parsing.idempotent_call(request, evaluation_request)
        if isinstance(evaluation_request.root, NightlyRequest) and "promote" not in key.scopes:
            raise Forbidden(f"a nightly run requires a key with the scope promote; the key {key.name} does not have it")
        evaluation_client = require_client(self._evaluation_client)

        def submit(registry: Registry) -> EvaluationRow:
            return registry.evaluations.submit(
                league,
                _pinned(evaluation_request, league, registry),
                actor=key.name,
                key=key.id,
                reason=evaluation_request.root.reason,
                max_active=self._settings.max_evaluations,
                max_of_league=self._settings.max_evaluations_per_league,
                call=call,
            )

        row = await self._models.change(submit, request.scope[DEADLINE])
        evaluation_client.notify()
        location = f"{self._settings.root_path}{request.url.path}/{row.id}"
        return JSONResponse(documents.evaluation_document(row), 202, {"location": location})

    async def page(self, request: Request) -> JSONResponse:
        """A page of a league's evaluations, without results. Raises UnknownLeague or InvalidInput."""
        league = check_slug("league", request.path_params["league"])
        limit = parsing.query_number(request, "limit", MAX_PAGE) or PAGE
        before = parsing.query_number(request, "before")
        rows = await self._models.query(
            lambda registry: registry.evaluations.newest(league, before=before, limit=limit + 1)
        )
        page, more = parsing.paginate(rows, limit, lambda row: row.id)
        summaries = [documents.evaluation_summary(row) for row in page]
        return JSONResponse({"league": league, "evaluations": summaries, "next": more})

    async def get(self, request: Request) -> JSONResponse:
        """One evaluation with its progress and result. Raises UnknownLeague or UnknownEvaluation."""
        league, number = parsing.evaluation_path(request)
        return JSONResponse(
            documents.evaluation_document(
                await self._models.query(lambda registry: registry.evaluations.get(league, number))
            )
        )

    async def stop(self, request: Request) -> JSONResponse:
        """Request the end of an evaluation; a finished one is unchanged. Raises UnknownLeague or UnknownEvaluation."""
        league, number = parsing.evaluation_path(request)
        key: ApiKey = request.scope[KEY]
        row = await self._models.change(
            lambda registry: registry.evaluations.stop(league, number, actor=key.name), request.scope[DEADLINE]
        )
        if self._evaluation_client is not None:
            self._evaluation_client.notify()
        return JSONResponse(documents.evaluation_document(row))


def _pinned(evaluation_request: EvaluationRequest, league: str, registry: Registry) -> dict[str, Any]:
    """The stored request, in which aliases are replaced by versions so that a resumed evaluation plays the same."""
    document = evaluation_request.root.model_dump(mode="json", exclude={"reason"})
    if isinstance(evaluation_request.root, TournamentRequest):
        for name in ("contestants", "against"):
            document[name] = [requested(ref, league, registry) for ref in getattr(evaluation_request.root, name)]
        document["contestants"] = document["contestants"] or [version.ref for version in eligible(registry, league)]
    return document
