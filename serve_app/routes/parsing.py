"""Parses query and path parameters, JSON bodies and idempotency keys of requests."""

import hashlib
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from typing import Any, TypeVar
from urllib.parse import parse_qsl

import orjson
from pydantic import BaseModel, ConfigDict, Field, RootModel, ValidationError
from starlette.requests import Request
from starlette.responses import Response
from starlette.types import Scope

from league.errors import InvalidInput, NotFound, UnknownEvaluation
from league.refs import check_slug
from league.registry.registry import Registry
from league.registry.storage.idempotency import IdempotentCall
from serve_app.access.access_control import KEY
from serve_app.access.api_keys import ApiKey
from serve_app.models.resolver import ModelResolver


async def query_response(models: ModelResolver, query: Callable[[Registry], dict[str, Any]]) -> Response:
    """The result of a registry query as JSON. Raises the errors of the query."""

    def query_json(registry: Registry) -> bytes:
        return orjson.dumps(query(registry))

    return Response(await models.query(query_json), media_type="application/json")


Row = TypeVar("Row")
Cursor = TypeVar("Cursor")

PAGE, MAX_PAGE = 50, 200
"""Rows of a page: default and maximum."""
MAX_NUMBER = 2**31 - 1
MAX_NAME_LENGTH = 300
"""Characters of a name or a cursor."""


def query_number(request: Request, name: str, largest: int = MAX_NUMBER, smallest: int = 1) -> int | None:
    """An integer of the query. Raises InvalidInput."""
    text = request.query_params.get(name)
    if text is None:
        return None
    if not (text.isascii() and text.isdigit() and len(text) <= 10 and smallest <= int(text) <= largest):
        raise InvalidInput(f"{name} must be an integer from {smallest} to {largest}, got {text[:32]!r}")
    return int(text)


def page_size(request: Request) -> int:
    """The requested number of rows of a page. Raises InvalidInput."""
    return query_number(request, "limit", MAX_PAGE) or PAGE


def query_name(request: Request, key: str) -> str | None:
    """A name or cursor of the query. Raises InvalidInput."""
    text = request.query_params.get(key)
    if text is not None and not _is_name(text):
        raise InvalidInput(f"{key} must be 1 to {MAX_NAME_LENGTH} printable characters, got {text[:32]!r}")
    return text


def query_time(request: Request, key: str) -> datetime | None:
    """A time of the query, in UTC. Raises InvalidInput."""
    text = request.query_params.get(key)
    if text is None:
        return None
    try:
        moment = datetime.fromisoformat(text)
        if moment.tzinfo is not None:
            return moment.astimezone(UTC)
    except (ValueError, OverflowError):
        pass
    raise InvalidInput(f"{key} must be a time with a time zone, such as 2026-03-03T14:00:00Z, got {text[:40]!r}")


def path_name(request: Request, key: str, unknown: type[NotFound]) -> str:
    """A name of the path. Raises `unknown` if no object can have that name."""
    text: str = request.path_params[key]
    if not _is_name(text):
        raise unknown(f"invalid name {text[:32]!r}")
    return text


def paginate(rows: Sequence[Row], limit: int, cursor: Callable[[Row], Cursor]) -> tuple[Sequence[Row], Cursor | None]:
    """The rows of a page, and the cursor of its end if there are more. `rows` must have one row more than a full
    page."""
    page = rows[:limit]
    return page, cursor(page[-1]) if len(rows) > limit else None


def _is_name(text: str) -> bool:
    """Whether databases accept the text: PostgreSQL refuses NUL characters."""
    return text.isprintable() and 1 <= len(text) <= MAX_NAME_LENGTH


MAX_PARAMETERS = 16
"""Maximum query parameters."""


def query_params(scope: Scope) -> dict[str, str]:
    """The query parameters. Raises InvalidInput."""
    text: bytes = scope["query_string"]
    if not text:
        return {}
    try:
        return dict(parse_qsl(text.decode("latin-1"), keep_blank_values=True, max_num_fields=MAX_PARAMETERS))
    except ValueError:
        raise InvalidInput(f"the query has more than {MAX_PARAMETERS} parameters") from None


def evaluation_path(request: Request) -> tuple[str, int]:
    """The league and the number of an evaluation in a path. Raises InvalidReference or UnknownEvaluation."""
    league, number = check_slug("league", request.path_params["league"]), request.path_params["evaluation"]
    if not (number.isascii() and number.isdigit() and len(number) <= 10 and int(number) <= MAX_NUMBER):
        raise UnknownEvaluation(f"league {league} has no evaluation {number[:32]!r}: expected a number")
    return league, int(number)


B = TypeVar("B", bound=BaseModel)

MAX_KEY_LENGTH = 255
"""Characters of an Idempotency-Key."""


class ChangeBody(BaseModel):
    """The body of a call that changes what is served."""

    model_config = ConfigDict(extra="forbid", strict=True)

    reason: str = Field(default="over HTTP", min_length=1, max_length=2000, pattern=r"^[^\x00]+$")


def parse_body(kind: type[B], body: bytes) -> B:
    """Validate a JSON body. Raises InvalidInput."""
    try:
        return kind.model_validate_json(body)
    except ValidationError as error:
        first = error.errors()[0]
        loc = first["loc"][1:] if issubclass(kind, RootModel) else first["loc"]  # omit the tag of the union
        where = ".".join(str(part) for part in loc) or "the body"
        # pydantic prefixes messages of validators.
        raise InvalidInput(f"{where}: {first['msg'].removeprefix('Value error, ')}") from None


def idempotent_call(request: Request, body: BaseModel) -> tuple[ApiKey, IdempotentCall]:
    """The key of the caller, and the identity of the call. Raises InvalidInput."""
    key: ApiKey = request.scope[KEY]
    content = f"{request.url.path} {body.model_dump_json(exclude_unset=True)}"
    digest = hashlib.sha256(content.encode()).hexdigest()
    return key, IdempotentCall(owner=key.id, key=_idempotency_key(request), digest=digest)


def _idempotency_key(request: Request) -> str:
    key = request.headers.get("idempotency-key", "")
    if not (1 <= len(key) <= MAX_KEY_LENGTH and key.isascii() and key.isprintable()):
        raise InvalidInput(
            f"the header Idempotency-Key must have 1 to {MAX_KEY_LENGTH} printable characters, unique to this call:"
            " send the same key when you repeat the call"
        )
    return key
