"""What changes what is served: an alias is pointed at a version, or the champion goes back to the one before.

POST /v1/leagues/{league}/aliases/{alias}   {"version": 3, "expected": 2, "reason": "…"}
POST /v1/leagues/{league}/rollback          {"reason": "…"}

Both take an API key of scope `promote`, whose name becomes the actor in the history, and an `Idempotency-Key`: a call
that comes again (a client that saw no answer repeats it, and so may HAProxy) is not applied again, and gets the same
answer for 24 hours. `expected` is the version that the alias must point to now, null if it must not exist; left out,
it may point anywhere.
"""

import hashlib
from collections.abc import Callable
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, RootModel, ValidationError
from starlette.requests import Request
from starlette.responses import JSONResponse

from league.errors import InvalidInput
from league.refs import MAX_VERSION, check_alias, check_slug
from league.registry.aliases import ANY
from league.registry.idempotency import Call
from league.registry.registry import Registry
from league.registry.rows import AliasEvent
from serve_app.bodies import read_body
from serve_app.doors import KEY
from serve_app.keyring import Key
from serve_app.models import Models
from serve_app.settings import ServeSettings

LONGEST = 255
"""Characters of an Idempotency-Key."""


class Change(BaseModel):
    """The body of a call that changes what is served."""

    model_config = ConfigDict(extra="forbid", strict=True)

    reason: str = Field(default="over HTTP", min_length=1, max_length=2000, pattern=r"^[^\x00]+$")


class Move(Change):
    """The body of a promotion."""

    version: int = Field(ge=1, le=MAX_VERSION)
    expected: int | None = Field(default=None, ge=1, le=MAX_VERSION)


class Return(Change):
    """The body of a rollback."""


B = TypeVar("B", bound=BaseModel)


class PromotionRoutes:
    """The endpoints. Doors lets only keys of scope `promote` come here."""

    def __init__(self, models: Models, settings: ServeSettings) -> None:
        self._models = models
        self._settings = settings

    async def move(self, request: Request) -> JSONResponse:
        """Point an alias at a version. Raises UnknownLeague, UnknownVersion, AliasMoved, KeyReused or InvalidInput."""
        league = check_slug("league", request.path_params["league"])
        alias = check_alias(request.path_params["alias"])
        body = parse(Move, await self._body(request))
        expected = body.expected if "expected" in body.model_fields_set else ANY

        def change(registry: Registry, actor: str, call: Call) -> AliasEvent:
            return registry.set_alias(
                league, alias, body.version, expected=expected, actor=actor, reason=body.reason, call=call
            )

        return await self._apply(request, body, change)

    async def roll_back(self, request: Request) -> JSONResponse:
        """Return to the champion before. Raises UnknownLeague, NothingToRollBack, KeyReused or InvalidInput."""
        league = check_slug("league", request.path_params["league"])
        body = parse(Return, await self._body(request) or b"{}")

        def change(registry: Registry, actor: str, call: Call) -> AliasEvent:
            return registry.rollback(league, actor=actor, reason=body.reason, call=call)

        return await self._apply(request, body, change)

    async def _body(self, request: Request) -> bytes:
        return await read_body(request.scope, request.receive, self._settings.max_body)

    async def _apply(
        self, request: Request, body: Change, change: Callable[[Registry, str, Call], AliasEvent]
    ) -> JSONResponse:
        key, call = call_of(request, body)
        event = await self._models.ask(lambda registry: change(registry, key.name, call))
        return JSONResponse(event_document(event))


def call_of(request: Request, body: BaseModel) -> tuple[Key, Call]:
    """Who calls, and the name of the call. Raises InvalidInput."""
    key: Key = request.scope[KEY]
    asked = f"{request.url.path} {body.model_dump_json(exclude_unset=True)}"
    digest = hashlib.sha256(asked.encode()).hexdigest()
    return key, Call(owner=key.id, key=_idempotency_key(request), digest=digest)


def _idempotency_key(request: Request) -> str:
    key = request.headers.get("idempotency-key", "")
    if not (1 <= len(key) <= LONGEST and key.isascii() and key.isprintable()):
        raise InvalidInput(
            f"the header Idempotency-Key must be 1 to {LONGEST} printable characters that you use for this call alone,"
            " and send again if you repeat it"
        )
    return key


def parse(kind: type[B], body: bytes) -> B:
    """The body of a change. Raises InvalidInput."""
    try:
        return kind.model_validate_json(body)
    except ValidationError as error:
        first = error.errors()[0]
        loc = first["loc"][1:] if issubclass(kind, RootModel) else first["loc"]  # without which of several it is
        where = ".".join(str(part) for part in loc) or "the body"
        # What a validator of ours says comes with pydantic's word for it.
        raise InvalidInput(f"{where}: {first['msg'].removeprefix('Value error, ')}") from None


def event_document(event: AliasEvent) -> dict[str, Any]:
    """A movement of an alias as JSON."""
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
