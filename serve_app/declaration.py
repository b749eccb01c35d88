"""Declarations of routes, from which the router, access control and the OpenAPI document are computed.

    @Declaration("GET", "/v1/leagues/{league}/runs", Page("runs", ListedRun, "run"), scope="read", tag="Results")
    def runs(registry: Registry, league: str, limit: int, before: str | None) -> Sequence[RunRow]:
        '''List training runs.

        Newest first.
        '''

The first paragraph of the docstring is the summary of the route, and the others are its description, except for one
that begins with `Raises`.
"""

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from datetime import UTC, datetime
from typing import Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict
from starlette.routing import compile_path

from league.errors import (
    InvalidInput,
    LeagueError,
    NotFound,
    UnknownEvaluation,
    UnknownMatch,
    UnknownRun,
    UnknownVerdict,
)
from league.refs import MAX_SLUG, MAX_VERSION, check_alias, check_slug

Scope = Literal["act", "read", "evaluate", "promote", "simulate"]
Handler = TypeVar("Handler", bound=Callable[..., Any])

JSON = ("application/json",)
EVENT_STREAM = ("text/event-stream",)
MAX_NAME_LENGTH = 300
"""Characters of a name or a cursor."""
MAX_KEY_LENGTH = 255
"""Characters of an Idempotency-Key."""
ALIAS = {"type": "string", "maxLength": MAX_SLUG, "pattern": "^[a-z0-9_-]*[a-z_-][a-z0-9_-]*$"}
NUMBER_OR_ALIAS = {"type": "string", "maxLength": MAX_SLUG, "pattern": "^[a-z0-9_-]+$"}
PATH_NAME = {"type": "string", "minLength": 1, "maxLength": MAX_NAME_LENGTH, "pattern": "^[^/]+$"}


class Response(BaseModel):
    """Base of the models of JSON responses, which are also read from the attributes of records."""

    model_config = ConfigDict(
        frozen=True,
        extra="forbid",
        from_attributes=True,
        validate_by_name=True,
        defer_build=True,
    )


@dataclass(frozen=True, slots=True)
class Parameter:
    """A parameter of a route.

    Attributes:
        name: Its name in the path, in the query, or of the header.
        schema: JSON Schema of its values.
        parse: Returns the value of a text, or raises LeagueError. Values of headers are not passed to handlers.
        default: The value if the parameter is missing.
        argument: The argument of the handler that gets the value, if it has another name.
    """

    name: str
    schema: Mapping[str, Any]
    description: str = ""
    place: Literal["path", "query", "header"] = "query"
    _: KW_ONLY
    parse: Callable[[str], Any] = str
    default: Any = None
    example: Any = None
    is_required: bool = False
    argument: str = ""

    @property
    def key(self) -> str:
        """The argument of the handler that gets the value."""
        return self.argument or self.name


def integer(
    name: str,
    description: str = "",
    smallest: int = 1,
    largest: int = MAX_VERSION,
    default: int | None = None,
    argument: str = "",
) -> Parameter:
    """A number of the query between `smallest` and `largest`."""

    def parse(value: str) -> int:
        if not (value.isascii() and value.isdigit() and len(value) <= 10 and smallest <= int(value) <= largest):
            raise InvalidInput(f"{name} must be an integer from {smallest} to {largest}, got {value[:32]!r}")
        return int(value)

    schema = _number(smallest, largest) | ({} if default is None else {"default": default})
    return Parameter(name, schema, description, parse=parse, default=default, argument=argument)


def text(name: str, description: str = "", example: str | None = None) -> Parameter:
    """A name or a cursor of the query."""

    parse = _named(InvalidInput, f"{name} must be 1 to {MAX_NAME_LENGTH} printable characters, got")
    schema = {"type": "string", "minLength": 1, "maxLength": MAX_NAME_LENGTH}
    return Parameter(name, schema, description, parse=parse, example=example)


def moment(name: str, description: str, example: str) -> Parameter:
    """A time of the query, in any time zone."""

    def parse(value: str) -> datetime:
        try:
            time = datetime.fromisoformat(value)
            if time.tzinfo is not None:
                return time.astimezone(UTC)
        except (ValueError, OverflowError):
            pass
        raise InvalidInput(f"{name} must be a time with a time zone, such as {example}, got {value[:40]!r}")

    return Parameter(name, {"type": "string", "format": "date-time"}, description, parse=parse, example=example)


def _number(smallest: int, largest: int = MAX_VERSION) -> dict[str, Any]:
    return {"type": "integer", "minimum": smallest, "maximum": largest}


def _named(refusal: type[LeagueError], problem: str = "invalid name") -> Callable[[str], str]:
    """A parser of names, which raises `refusal` if no object can have that name."""

    def parse(value: str) -> str:
        # PostgreSQL refuses NUL characters.
        if not (value.isprintable() and 1 <= len(value) <= MAX_NAME_LENGTH):
            raise refusal(f"{problem} {value[:32]!r}")
        return value

    return parse


def _numbered(what: str, unknown: type[NotFound], largest: int) -> Callable[[str], int]:
    """A parser of numbers, which raises `unknown` if no object can have that number."""

    def parse(value: str) -> int:
        if not (value.isascii() and value.isdigit() and len(value) <= 10 and int(value) <= largest):
            raise unknown(f"there is no {what} {value[:32]!r}: expected a number")
        return int(value)

    return parse


def _segment(
    name: str, schema: Mapping[str, Any], parse: Callable[[str], Any], example: Any, description: str = ""
) -> Parameter:
    return Parameter(name, schema, description, "path", parse=parse, example=example, is_required=True)


MAX_GAME = 999_999_999
IN_PATH = {
    parameter.name: parameter
    for parameter in (
        _segment(
            "model",
            {"type": "string", "maxLength": 2 * MAX_SLUG + 1, "pattern": "^[a-z0-9_-]+(\\.[a-z0-9_-]+)?$"},
            str,
            "connect_four",
            "A league, or `league.policy` if its versions have several policies.",
        ),
        _segment("league", NUMBER_OR_ALIAS, lambda value: check_slug("league", value), "connect_four"),
        _segment("version", NUMBER_OR_ALIAS, str, "champion", "A number or an alias."),
        _segment("alias", ALIAS, check_alias, "champion", "A movable name for a version; not only digits."),
        _segment("verdict", PATH_NAME, _named(UnknownVerdict), "connect_four-verdict-0c1d"),
        _segment("schedule", PATH_NAME, _named(UnknownMatch), "connect_four-round_robin-9f86"),
        _segment("position", _number(0), _named(UnknownMatch), 0),
        _segment("game", _number(0, MAX_GAME), _numbered("game", UnknownMatch, MAX_GAME), 0),
        _segment("run", PATH_NAME, _named(UnknownRun), "first"),
        _segment("evaluation", _number(1), _numbered("evaluation", UnknownEvaluation, MAX_VERSION), 1),
    )
}
"""The parameters of paths, by name."""
VERSION = Parameter("version", NUMBER_OR_ALIAS, "A number or an alias; default: `champion`.")
CALLER = Parameter(
    "x-league-key",
    {"type": "string", "maxLength": 1000},
    "A routing key, for example of a player or an episode. With canary traffic, requests with the same key use the same"
    " version.",
    "header",
)
TIMEOUT = Parameter(
    "x-request-timeout-ms",
    {"type": "integer", "minimum": 1, "maximum": 999_999_999},
    "Timeout in milliseconds.",
    "header",
)
IDEMPOTENCY_KEY = Parameter(
    "Idempotency-Key",
    {"type": "string", "minLength": 1, "maxLength": MAX_KEY_LENGTH},
    "A unique key for this call; use the same key if you retry the call.",
    "header",
    example="promote-2026-11-20-a",
    is_required=True,
)
REPLICA_HEADER = Parameter("x-league-replica", {"type": "string"}, "The replica that handled the request.", "header")


@dataclass(frozen=True, slots=True)
class Page:
    """A response with some rows of a list, and the cursor of the next ones.

    The handler gets `limit`, one more than the rows of a page, and `before`, the cursor of the previous page. It
    returns at most `limit` rows, of which the last one is only counted.

    Attributes:
        key: Name of the list in the response.
        item: Model of a row.
        cursor: The field of a row that continues the list.
        size: Rows of a page by default.
        largest: Rows of a page at most.
        is_whole: Whether all rows are returned without `limit` and `before`; `limit` is None then.
    """

    key: str
    item: type[Response]
    cursor: str
    size: int = 50
    largest: int = 200
    is_whole: bool = False

    @property
    def has_number(self) -> bool:
        """Whether the cursor is a number."""
        return self.item.model_fields[self.cursor].annotation is int

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The parameters that select a page."""
        before = (integer if self.has_number else text)("before", "`next` of the previous page.")
        limit = integer("limit", "Maximum number of rows.", largest=self.largest, default=self.size)
        return limit, before

    def to_json(self, rows: Sequence[Any], limit: int | None) -> dict[str, Any]:
        """The response for the rows that a handler returned for `limit`."""
        items = [self.item.model_validate(row) for row in rows]
        more = limit is not None and len(items) >= limit
        page = items[:-1] if more else items
        return {
            self.key: [item.model_dump() for item in page],
            "next": getattr(page[-1], self.cursor) if more else None,
        }


@dataclass(frozen=True, slots=True)
class Declaration:
    """A route; as a decorator, it declares the route of a handler, of which there may be several.

    Attributes:
        method: HTTP method, or `WEBSOCKET`.
        path: Path of the route, with names of parameters in braces (IN_PATH, unless the route is not part of the API).
        response: What a successful request gets: a model, a page, the name of a schema in `openapi.yaml`, or None for
            text and pictures.
        scope: Scope that a key needs; None if the route is public.
        tag: Its section in the OpenAPI document; None for web pages, which are not part of the API.
        name: Its id in the OpenAPI document; by default the name of the handler.
        summary: By default the first paragraph of the handler's docstring.
        description: The other paragraphs.
        success: What a successful request gets, in a sentence, unless the docstring of the model says it.
        status: Status of a successful response.
        media: Media types of the response.
        headers: Headers of a successful response.
        parameters: Parameters in the query and in headers, without those of a page.
        body: Model of the body, or the name of a schema in `openapi.yaml`.
        body_media: Media types of the body.
        is_body_optional: Whether the body may be empty.
        errors: Errors besides those of every route of its kind.
        is_of_all: Whether a route without a league in its path concerns all of them, so that the key of some leagues
            does not suffice.
    """

    method: str
    path: str
    response: type[BaseModel] | Page | str | None = None
    _: KW_ONLY
    scope: Scope | None
    tag: str | None
    name: str = ""
    summary: str = ""
    description: str = ""
    success: str = ""
    status: int = 200
    media: tuple[str, ...] = JSON
    headers: tuple[Parameter, ...] = ()
    parameters: tuple[Parameter, ...] = ()
    body: type[BaseModel] | str | None = None
    body_media: tuple[str, ...] = JSON
    is_body_optional: bool = False
    errors: tuple[type[LeagueError], ...] = ()
    is_of_all: bool = True

    def __call__(self, handler: Handler) -> Handler:
        """Declare the route of a handler, whose docstring describes it."""
        paragraphs = inspect.cleandoc(handler.__doc__ or "").split("\n\n")
        first, *description = [paragraph for paragraph in paragraphs if not paragraph.startswith("Raises ")]
        declaration = replace(
            self,
            name=self.name or handler.__name__,
            summary=self.summary or " ".join(first.split()).removesuffix("."),
            description=self.description or "\n\n".join(description),
        )
        handler.declarations = (declaration, *getattr(handler, "declarations", ()))  # type: ignore[attr-defined]
        return handler

    @property
    def is_change(self) -> bool:
        """Whether it changes what is served or recorded, which always requires a key."""
        return self.scope in ("evaluate", "promote", "simulate") and self.method != "GET"

    @property
    def is_applied_once(self) -> bool:
        """Whether a repeated call, with the same Idempotency-Key, is not applied again."""
        return self.is_change and self.method == "POST"

    @property
    def path_names(self) -> list[str]:
        """The names of the parameters in the path, in order."""
        return list(compile_path(self.path)[2])

    @property
    def query_parameters(self) -> list[Parameter]:
        """The parameters in the query."""
        return [parameter for parameter in self.other_parameters if parameter.place == "query"]

    @property
    def other_parameters(self) -> list[Parameter]:
        """The parameters in the query and in headers."""
        page = self.response.parameters if isinstance(self.response, Page) else ()
        return [*page, *self.parameters, *([IDEMPOTENCY_KEY] if self.is_applied_once else ())]


def declared(owner: Any) -> list[tuple[Declaration, str]]:
    """The declarations in a module or a class, or of the class of an object, with the names of their handlers."""
    members = vars(owner if inspect.ismodule(owner) or inspect.isclass(owner) else type(owner))
    return [
        (declaration, name) for name, member in members.items() for declaration in getattr(member, "declarations", ())
    ]
