"""Describes declared routes as OpenAPI path items, and the models of their bodies and responses as JSON Schema."""

import inspect
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from pydantic import BaseModel
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaMode, JsonSchemaValue, models_json_schema
from pydantic_core import core_schema

from league.errors import (
    ArtifactCorrupt,
    BodyTooLarge,
    DeadlineExceeded,
    Forbidden,
    GraphTimeout,
    InvalidInput,
    InvalidReference,
    KeyReused,
    LeagueError,
    NoSearchService,
    NotReady,
    Overloaded,
    RateLimited,
    StorageError,
    Unauthenticated,
    UnknownAlias,
    UnknownLeague,
    UnknownPolicy,
    UnknownVersion,
    VersionRetired,
)
from serve_app.access.errors import (
    CODES,
    BodyTooSlow,
    CrossSiteRequest,
    MalformedBody,
    UnsupportedMediaType,
    UntrustedHost,
    status_of,
)
from serve_app.declaration import IN_PATH, JSON, Declaration, Page, Parameter
from serve_app.routes.documents import Error

Document = dict[str, Any]

SCHEMAS, PARAMETERS = "#/components/schemas/", "#/components/parameters/"
KEY: list[Document] = [{"bearer": []}, {"header": []}]
OPEN_INFERENCE = "/v2"
"""Paths of the Open Inference Protocol, which has another form of errors."""
HEADERS: dict[int, Document] = {
    401: {"www-authenticate": {"schema": {"type": "string"}}},
    429: {
        "retry-after": {"description": "Seconds to wait before a retry.", "schema": {"type": "integer", "minimum": 1}}
    },
}
HEADERS[503] = HEADERS[429]
UNLISTED = {404: "No route has this path.", 500: "An internal error, which the log of the server explains."}
"""Status → what an error means that is not a LeagueError."""


class _SchemaGenerator(GenerateJsonSchema):
    """Schemas without titles; without defaults, because generated clients would require fields that have one; and with
    one schema for all elements of a tuple, which more tools support."""

    def field_title_should_be_set(self, schema: Any) -> bool:  # noqa: ARG002
        return False

    def default_schema(self, schema: core_schema.WithDefaultSchema) -> JsonSchemaValue:
        inner = self.generate_inner(schema["schema"])
        default = schema.get("default")
        if self.mode == "serialization" or default is None or default == ():
            return inner
        return inner | {"description": " ".join((inner.get("description", ""), f"Default: `{default}`.")).strip()}

    def tuple_schema(self, schema: core_schema.TupleSchema) -> JsonSchemaValue:
        document = super().tuple_schema(schema)
        items = document.get("prefixItems", [])
        if items and all(item == items[0] for item in items):
            del document["prefixItems"]
            document["items"] = items[0]
        return document

    def field_is_required(self, field: Any, total: bool) -> bool:
        return self.mode == "serialization" or super().field_is_required(field, total)


def describe(
    routes: Iterable[Declaration], requests: Mapping[str, Any], responses: Mapping[str, Any]
) -> tuple[Document, Document]:
    """The path items of the routes, and the components that these refer to: schemas, parameters and responses.

    requests, responses: name of a route → examples of its body, and an example of its response.
    """
    routes = [route for route in routes if route.tag is not None]
    models = dict.fromkeys(model for route in routes for model in _models(route))
    references, definitions = models_json_schema(
        [*models, (Error, "serialization")], ref_template=SCHEMAS + "{model}", schema_generator=_SchemaGenerator
    )
    schemas = definitions["$defs"]
    parameters = {name: _parameter(declared) for name, declared in IN_PATH.items()}
    components: Document = {"schemas": schemas, "parameters": parameters, "responses": {}}
    for schema in schemas.values():
        schema.pop("title", None)
    paths: Document = {}
    for route in routes:
        item = paths.setdefault(route.path, {})
        if route.path_names:
            item["parameters"] = [{"$ref": f"{PARAMETERS}{name}"} for name in route.path_names]
        content: Any = {"type": "string"}
        match route.response:
            case str() as name:
                content = {"$ref": SCHEMAS + name}
            case Page() as page:
                name = page.key.title().replace("_", "")
                schemas[name] = _page(page, references[page.item, "serialization"], route.path_names)
                content = {"$ref": SCHEMAS + name}
            case type() as model:
                content = references[model, "serialization"]
        examples = {"examples": {"one": {"value": responses[route.name]}}} if route.name in responses else {}
        method = "get" if route.method == "WEBSOCKET" else route.method.lower()
        errors = _errors(route)
        components["responses"] |= errors
        item[method] = _operation(route) | {
            "responses": {str(route.status): _success(route, content, examples)}
            | {name.partition("-")[0]: {"$ref": f"#/components/responses/{name}"} for name in errors}
        }
        if route.body is not None:
            body = route.body
            schema = {"$ref": SCHEMAS + body} if isinstance(body, str) else references[body, "validation"]
            item[method]["requestBody"] = _body(route, schema, requests.get(route.name))
    return paths, components


def _parameter(declared: Parameter) -> Document:
    """A parameter object."""
    optional = {"required": declared.is_required, "description": declared.description, "example": declared.example}
    document: Document = {"name": declared.name, "in": declared.place, "schema": dict(declared.schema)}
    return document | {key: value for key, value in optional.items() if value not in (None, "") and value is not False}


def _models(route: Declaration) -> Iterator[tuple[type[BaseModel], JsonSchemaMode]]:
    if isinstance(route.body, type):
        yield route.body, "validation"
    if isinstance(route.response, Page):
        yield route.response.item, "serialization"
    elif isinstance(route.response, type):
        yield route.response, "serialization"


def _page(page: Page, item: JsonSchemaValue, names: Iterable[str]) -> Document:
    cursor = {"type": ["integer" if page.has_number else "string", "null"]}
    properties = {name: {"type": "string"} for name in names} | {
        page.key: {"type": "array", "items": item},
        "next": cursor | {"description": "`before` of the next page; null on the last page."},
    }
    return {"type": "object", "required": list(properties), "properties": properties, "additionalProperties": False}


def _operation(route: Declaration) -> Document:
    optional = {
        "description": route.description,
        "x-scope": route.scope,
        "parameters": list(map(_parameter, route.other_parameters)),
    }
    security = {"security": [] if route.scope is None else KEY} if route.is_change or route.scope is None else {}
    required = {"tags": [route.tag], "operationId": route.name, "summary": route.summary}
    return required | {key: value for key, value in optional.items() if value} | security


def _body(route: Declaration, schema: Document, examples: Any) -> Document:
    content: Document = {media: {"schema": schema} if media in JSON else _text(media) for media in route.body_media}
    if examples is not None:
        content[JSON[0]]["examples"] = examples
    return {"content": content} | ({} if route.is_body_optional else {"required": True})


def _success(route: Declaration, schema: Document, examples: Document) -> Document:
    description = route.success
    match route.response:
        case Page() as page if not description:
            description = f"A page of {page.key.replace('_', ' ')}."
        case type() as model if not description:
            description = inspect.cleandoc(model.__doc__ or "")
    response: Document = {"description": description}
    if route.headers:
        response["headers"] = {
            header.name: {"description": header.description, "schema": dict(header.schema)} for header in route.headers
        }
    if route.method != "WEBSOCKET":
        response["content"] = {
            media: {"schema": schema} | examples if media in JSON else _text(media) for media in route.media
        }
    return response


def _text(media: str) -> Document:
    kind = {} if media.startswith("text/") else {"contentMediaType": media}
    return {"schema": {"type": "string"} | kind}


def _errors(route: Declaration) -> Document:
    """The responses with errors, by status and codes."""
    meanings: dict[int, dict[str, str]] = {500: {"internal_error": UNLISTED[500]}}
    for error in _possible(route):
        sentence = inspect.cleandoc(error.__doc__ or "").partition(". ")[0].partition("\n")[0].removesuffix(".") + "."
        meanings.setdefault(status_of(error("")), {})[error.code] = sentence
    if route.path_names:
        meanings.setdefault(404, {})[CODES[404]] = UNLISTED[404]
    is_open_inference = route.path.startswith(OPEN_INFERENCE)
    responses: Document = {}
    for status in sorted(meanings):
        codes = list(meanings[status])
        name = "-".join((str(status), *codes, *(["v2"] if is_open_inference else ())))
        if is_open_inference:
            schema: Document = {"$ref": f"{SCHEMAS}OpenInferenceError"}
        else:
            schema = {"allOf": [{"$ref": f"{SCHEMAS}Error"}, {"properties": {"code": {"enum": codes}}}]}
        headers = {"headers": HEADERS[status]} if status in HEADERS else {}
        description = " ".join(meanings[status].values())
        responses[name] = {"description": description} | headers | {"content": {JSON[0]: {"schema": schema}}}
    return responses


def _possible(route: Declaration) -> Iterator[type[LeagueError]]:
    """The errors of a route: those of every route of its kind, and those that it declares."""
    yield InvalidInput
    if route.path_names:
        yield InvalidReference
    if "league" in route.path_names:
        yield UnknownLeague
    if "model" in route.path_names:
        yield from (UnknownLeague, UnknownPolicy, UnknownVersion, UnknownAlias, VersionRetired, GraphTimeout)
        yield NoSearchService
    if route.scope is not None:
        yield from (Unauthenticated, Forbidden, UntrustedHost, Overloaded, RateLimited)
        yield from (NotReady, ArtifactCorrupt, StorageError)
        if route.method != "GET":
            yield CrossSiteRequest
    if route.body is not None:
        yield from (MalformedBody, BodyTooSlow, BodyTooLarge, UnsupportedMediaType)
    if route.is_applied_once:
        yield KeyReused
    yield DeadlineExceeded
    yield from route.errors
