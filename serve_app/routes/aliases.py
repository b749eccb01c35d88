"""Moves aliases (promotion, rollback) and lists their history.

    GET   /v1/leagues/{league}/aliases/{alias}/history    newest first; ?limit= &before=
                                                          ?at=2026-03-03T14:00:00Z: the event in force at that time
    POST  /v1/leagues/{league}/aliases/{alias}   {"version": 3, "expected": 2, "reason": "…"}
                                                          {"members": [{"version": 3, "probability": 0.6}, …]}
    POST  /v1/leagues/{league}/rollback          {"expected": 3, "reason": "…"}

POST requires an API key of scope `promote`, whose name becomes the actor in the history, and an `Idempotency-Key`: a
repeated call (a retry by a client or by HAProxy) is not applied again and gets the same response for 24 hours.
`expected` is the version that the alias must point to now, or null if it must not exist; without it there is no such
condition.
"""

from collections.abc import Callable
from typing import Any, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator
from starlette.requests import Request
from starlette.responses import JSONResponse, Response

from league.errors import InvalidInput
from league.refs import MAX_VERSION, check_alias, check_slug
from league.registry.aliases import ANY
from league.registry.registry import Registry
from league.registry.storage.idempotency import IdempotentCall
from league.registry.storage.rows import AliasEvent
from serve_app.access.access_control import DEADLINE
from serve_app.access.request_body import MAX_CHANGE_BODY, read_body
from serve_app.models.resolver import ModelResolver
from serve_app.routes import parsing

MAX_MEMBERS = 100
"""Members of a mixture."""


class MemberBody(BaseModel):
    """A member of a mixture."""

    model_config = ConfigDict(extra="forbid", strict=True)

    version: int = Field(ge=1, le=MAX_VERSION)
    probability: float = Field(gt=0, le=1)


class PromotionBody(parsing.ChangeBody):
    """The body of a promotion, of a version or of a mixture."""

    version: int | None = Field(default=None, ge=1, le=MAX_VERSION)
    members: list[MemberBody] | None = Field(default=None, max_length=MAX_MEMBERS)
    expected: int | None = Field(default=None, ge=1, le=MAX_VERSION)

    @model_validator(mode="after")
    def _has_one_target(self) -> Self:
        if (self.version is None) == (self.members is None):
            raise ValueError("expected either version, or members with their probabilities")
        numbers = [member.version for member in self.members or ()]
        if len(set(numbers)) < len(numbers):
            raise ValueError("members: a version is named twice")
        return self

    def target(self, registry: Registry, league: str) -> int:
        """The version to promote; a mixture is published. Raises the errors of `publish_mixture`."""
        if self.version is not None:
            return self.version
        shares = {member.version: member.probability for member in self.members or ()}
        return registry.publisher.publish_mixture(league, shares).number


class RollbackBody(parsing.ChangeBody):
    """The body of a rollback."""

    expected: int | None = Field(default=None, ge=1, le=MAX_VERSION)


class AliasRoutes:
    """The endpoints. Access control requires the scope `promote` for POST."""

    def __init__(self, models: ModelResolver) -> None:
        self._models = models

    async def history(self, request: Request) -> Response:
        """A page of an alias's events. Raises UnknownLeague or InvalidInput."""
        league = check_slug("league", request.path_params["league"])
        alias = check_alias(request.path_params["alias"])
        limit, before = parsing.page_size(request), parsing.query_number(request, "before")
        at = parsing.query_time(request, "at")
        if at is not None and before is not None:
            raise InvalidInput("at and before are mutually exclusive")

        def query(registry: Registry) -> dict[str, Any]:
            rows = registry.aliases.history(league, alias, at, before=before, limit=limit + 1)
            page, more = parsing.paginate(rows, limit, lambda row: row.id)
            return {"league": league, "alias": alias, "history": list(map(event_document, page)), "next": more}

        return await parsing.query_response(self._models, query)

    async def move(self, request: Request) -> JSONResponse:
        """Point an alias at a version or a mixture.

        Raises UnknownLeague, UnknownVersion, VersionRetired, NotPromotable, EnvironmentMismatch, AliasMoved,
        KeyReused or InvalidInput.
        """
        league = check_slug("league", request.path_params["league"])
        alias = check_alias(request.path_params["alias"])
        body = parsing.parse_body(PromotionBody, await self._body(request))
        expected = body.expected if "expected" in body.model_fields_set else ANY

        def change(registry: Registry, actor: str, call: IdempotentCall) -> AliasEvent:
            return registry.aliases.set(
                league,
                alias,
                body.target(registry, league),
                expected=expected,
                actor=actor,
                reason=body.reason,
                call=call,
            )

        return await self._apply(request, body, change)

    async def roll_back(self, request: Request) -> JSONResponse:
        """Restore the previous champion.

        Raises UnknownLeague, AliasMoved, NothingToRollBack, KeyReused or InvalidInput.
        """
        league = check_slug("league", request.path_params["league"])
        body = parsing.parse_body(RollbackBody, await self._body(request) or b"{}")
        expected = ANY if body.expected is None else body.expected

        def change(registry: Registry, actor: str, call: IdempotentCall) -> AliasEvent:
            return registry.aliases.rollback(league, expected=expected, actor=actor, reason=body.reason, call=call)

        return await self._apply(request, body, change)

    async def _body(self, request: Request) -> bytes:
        return await read_body(request.scope, request.receive, MAX_CHANGE_BODY)

    async def _apply(
        self, request: Request, body: parsing.ChangeBody, change: Callable[[Registry, str, IdempotentCall], AliasEvent]
    ) -> JSONResponse:
        key, call = parsing.idempotent_call(request, body)
        event = await self._models.change(lambda registry: change(registry, key.name, call), request.scope[DEADLINE])
        return JSONResponse(event_document(event))


def event_document(event: AliasEvent) -> dict[str, Any]:
    """An alias event as JSON."""
    return {
        "league": event.league,
        "alias": event.alias,
        "kind": event.kind,
        "version": event.version,
        "previous": event.previous,
        "actor": event.actor,
        "reason": event.reason,
        "verdict": event.verdict,
        "at": event.at.isoformat(),
        "event": event.id,
    }
