"""Builds the endpoints of declared routes.

The handler of a route is

- a function of the registry, the parameters and the body, which returns the response as a record. It runs in a thread.
  One that changes something also gets the `key` of the caller, and if it is to be applied once, the `call`;
- an `async` method of the request and the same values, which returns the response or an ASGI application;
- or an ASGI application, an object whose `__call__` is declared.
"""

import hashlib
import inspect
from collections.abc import Callable, Iterable, Mapping
from typing import Any, TypeVar

import orjson
from pydantic import BaseModel, RootModel, ValidationError
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import BaseRoute, Route, WebSocketRoute
from starlette.types import ASGIApp

from league.errors import InvalidInput
from league.registry.registry import Registry
from league.registry.storage.idempotency import IdempotentCall
from serve_app.access.access_control import DEADLINE, KEY
from serve_app.access.request_body import MAX_CHANGE_BODY, read_body
from serve_app.declaration import IDEMPOTENCY_KEY, IN_PATH, MAX_KEY_LENGTH, Declaration, Page, Parameter, declared
from serve_app.live_versions.resolver import ModelResolver

Body = TypeVar("Body", bound=BaseModel)
Values = dict[str, Any]


def routes_of(owner: Any, models: ModelResolver) -> list[BaseRoute]:
    """The routes whose handlers are in a module or are methods of an object."""
    routes: list[BaseRoute] = []
    for declaration, name in declared(owner):
        if declaration.method == "WEBSOCKET":
            routes.append(WebSocketRoute(declaration.path, owner))
            continue
        endpoint = owner if name == "__call__" else _endpoint(declaration, getattr(owner, name), models)
        is_documented = declaration.tag is not None
        routes.append(Route(declaration.path, endpoint, methods=[declaration.method], include_in_schema=is_documented))
    return routes


def parse_body(kind: type[Body], body: bytes) -> Body:
    """Validate a JSON body. Raises InvalidInput."""
    try:
        return kind.model_validate_json(body)
    except ValidationError as error:
        first = error.errors()[0]
        loc = first["loc"][1:] if issubclass(kind, RootModel) else first["loc"]  # omit the tag of the union
        where = ".".join(str(part) for part in loc) or "the body"
        # pydantic prefixes messages of validators.
        raise InvalidInput(f"{where}: {first['msg'].removeprefix('Value error, ')}") from None


def _endpoint(declaration: Declaration, handler: Callable[..., Any], models: ModelResolver) -> Callable[..., Any]:
    parameters = declaration.query_parameters

    async def respond(request: Request) -> ASGIApp:
        values = await _values(declaration, parameters, request)
        if inspect.iscoroutinefunction(handler):
            result = await handler(request, **values)
            return result if callable(result) else _json(declaration, _encoded(declaration, request, values, result))

        def encode(registry: Registry) -> bytes:
            return _encoded(declaration, request, values, handler(registry, **values))

        if declaration.is_change:
            return _json(declaration, await models.in_change_thread(encode, request.scope[DEADLINE]))
        return _json(declaration, await models.in_registry_thread(encode))

    return respond


async def _values(declaration: Declaration, parameters: Iterable[Parameter], request: Request) -> Values:
    """The arguments of a handler. parameters: those in the query.

    Raises InvalidInput, InvalidReference, NotFound, and the errors of `read_body`.
    """
    values: Values = dict(request.path_params)
    if declaration.tag is not None:
        values = {name: IN_PATH[name].parse(value) for name, value in values.items()}
    for parameter in parameters:
        value = request.query_params.get(parameter.name)
        values[parameter.key] = parameter.default if value is None else parameter.parse(value)
    page = declaration.response
    if isinstance(page, Page):
        is_whole = page.is_whole and {"limit", "before"}.isdisjoint(request.query_params.keys())
        values["limit"] = None if is_whole else values["limit"] + 1
    if isinstance(declaration.body, type):
        body = await read_body(request.scope, request.receive, MAX_CHANGE_BODY)
        values["body"] = parse_body(declaration.body, body or b"{}" if declaration.is_body_optional else body)
    if declaration.is_change:
        values["key"] = request.scope[KEY]
    if declaration.is_applied_once:
        values["call"] = _call(request, values)
    return values


def _call(request: Request, values: Mapping[str, Any]) -> IdempotentCall:
    """The identity of a call. Raises InvalidInput."""
    key = request.headers.get(IDEMPOTENCY_KEY.name, "")
    if not (1 <= len(key) <= MAX_KEY_LENGTH and key.isascii() and key.isprintable()):
        raise InvalidInput(
            f"the header Idempotency-Key must have 1 to {MAX_KEY_LENGTH} printable characters, unique to this call:"
            " send the same key when you repeat the call"
        )
    content = f"{request.url.path} {values['body'].model_dump_json(exclude_unset=True)}"
    return IdempotentCall(owner=values["key"].id, key=key, digest=hashlib.sha256(content.encode()).hexdigest())


def _encoded(declaration: Declaration, request: Request, values: Values, result: Any) -> bytes:
    match declaration.response:
        case Page() as page:
            named = {name: values[name] for name in request.path_params}
            return orjson.dumps(named | page.to_json(result, values["limit"]))
        case type() as model:
            return orjson.dumps(model.model_validate(result).model_dump())
        case _:
            return orjson.dumps(result)


def _json(declaration: Declaration, content: bytes) -> Response:
    return Response(content, declaration.status, media_type="application/json")
