"""Starts, lists and stops evaluations: games between versions of a league, played by the evaluation service.

A request is validated, written to the registry, and played by the evaluation service; any replica reports its progress.
"""

from collections.abc import Sequence
from typing import Any

import orjson
from starlette.requests import Request
from starlette.responses import Response

from league.errors import (
    EnvironmentMismatch,
    Forbidden,
    NoEvaluationService,
    TooManyEvaluations,
    UnknownAlias,
    UnknownEvaluation,
    UnknownPolicy,
    UnknownVersion,
)
from league.policies.loading import eligible, requested
from league.registry.registry import Registry
from league.registry.storage.idempotency import IdempotentCall
from league.registry.storage.rows import EvaluationRow
from league.service_requests import EvaluationRequest, NightlyRequest, TournamentRequest
from serve_app.access.access_control import DEADLINE
from serve_app.access.api_keys import ApiKey
from serve_app.declaration import Declaration, Page, Parameter
from serve_app.evaluation_client import EvaluationClient, require_client
from serve_app.live_versions.resolver import ModelResolver
from serve_app.routes.documents import Evaluation, EvaluationSummary
from serve_app.settings import ServeSettings


@Declaration(
    "GET",
    "/v1/leagues/{league}/evaluations",
    Page("evaluations", EvaluationSummary, "evaluation", size=20, largest=100),
    scope="read",
    tag="Evaluation",
)
def evaluations(registry: Registry, league: str, limit: int, before: int | None) -> Sequence[EvaluationRow]:
    """List evaluations.

    Newest first, without results.
    """
    return registry.evaluations.newest(league, before=before, limit=limit)


@Declaration(
    "GET",
    "/v1/leagues/{league}/evaluations/{evaluation}",
    Evaluation,
    scope="read",
    tag="Evaluation",
    errors=(UnknownEvaluation,),
)
def evaluation(registry: Registry, league: str, evaluation: int) -> EvaluationRow:
    """Get an evaluation.

    The progress and, once the state is `done`, the `result`: ratings and payoffs; for a nightly run also verdicts and
    the champion.
    """
    return registry.evaluations.get(league, evaluation)


class EvaluationRoutes:
    """The endpoints that notify the evaluation service."""

    def __init__(
        self, models: ModelResolver, settings: ServeSettings, evaluation_client: EvaluationClient | None
    ) -> None:
        self._models = models
        self._settings = settings
        self._evaluation_client = evaluation_client

    @Declaration(
        "POST",
        "/v1/leagues/{league}/evaluations",
        Evaluation,
        scope="evaluate",
        tag="Evaluation",
        success="The evaluation was queued.",
        status=202,
        headers=(Parameter("location", {"type": "string"}, "The URL of the evaluation."),),
        body=EvaluationRequest,
        is_body_optional=True,
        errors=(
            UnknownVersion,
            UnknownAlias,
            UnknownPolicy,
            EnvironmentMismatch,
            TooManyEvaluations,
            NoEvaluationService,
        ),
    )
    async def evaluate(
        self, request: Request, league: str, body: EvaluationRequest, key: ApiKey, call: IdempotentCall
    ) -> Response:
        """Start an evaluation.

        A **tournament** plays `blocks` matches between each pair of contestants, including the scripted baselines. Its
        games count for ratings; no version is promoted. Aliases are resolved when the evaluation is created.

        A **nightly run** does the same as `league nightly`: it tests new versions, promotes the strongest and updates
        all ratings. It also requires the scope `promote`. It cannot train exploiters: a verdict that needs new ones
        (`gate.exploiters`) waits for `league nightly`.

        References are validated immediately. The response is sent before the first game; poll `location` for progress.
        """
        if isinstance(body.root, NightlyRequest) and "promote" not in key.scopes:
            raise Forbidden(f"a nightly run requires a key with the scope promote; the key {key.name} does not have it")
        evaluation_client = require_client(self._evaluation_client)

        def submit(registry: Registry) -> EvaluationRow:
            return registry.evaluations.submit(
                league,
                _pinned(body, league, registry),
                actor=key.name,
                key=key.id,
                reason=body.root.reason,
                max_active=self._settings.max_evaluations,
                max_of_league=self._settings.max_evaluations_per_league,
                call=call,
            )

        row = await self._models.in_change_thread(submit, request.scope[DEADLINE])
        evaluation_client.notify()
        headers = {"location": f"{self._settings.root_path}{request.url.path}/{row.id}"}
        content = orjson.dumps(Evaluation.model_validate(row).model_dump())
        return Response(content, 202, headers, media_type="application/json")

    @Declaration(
        "DELETE",
        "/v1/leagues/{league}/evaluations/{evaluation}",
        Evaluation,
        scope="evaluate",
        tag="Evaluation",
        errors=(UnknownEvaluation,),
    )
    async def stop_evaluation(self, request: Request, league: str, evaluation: int, key: ApiKey) -> EvaluationRow:
        """Stop an evaluation.

        A queued evaluation stops immediately, a running one within seconds. The call has no effect on an evaluation
        that has ended, so it can be repeated. Completed games stay in the ledger: the same evaluation, started again,
        continues after them.
        """
        row = await self._models.in_change_thread(
            lambda registry: registry.evaluations.stop(league, evaluation, actor=key.name), request.scope[DEADLINE]
        )
        if self._evaluation_client is not None:
            self._evaluation_client.notify()
        return row


def _pinned(evaluation_request: EvaluationRequest, league: str, registry: Registry) -> dict[str, Any]:
    """The stored request, in which aliases are replaced by versions so that a resumed evaluation plays the same."""
    document = evaluation_request.root.model_dump(mode="json", exclude={"reason"})
    if isinstance(evaluation_request.root, TournamentRequest):
        for name in ("contestants", "against"):
            document[name] = [requested(ref, league, registry) for ref in getattr(evaluation_request.root, name)]
        document["contestants"] = document["contestants"] or [version.ref for version in eligible(registry, league)]
    return document
