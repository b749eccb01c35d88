"""The description is a valid OpenAPI document, of the routes that there are, with the errors that they have."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from jsonschema import Draft202012Validator
from openapi_spec_validator import OpenAPIV31SpecValidator
from starlette.routing import Route, WebSocketRoute
from starlette.testclient import TestClient

from league.errors import LeagueError
from league.registry.registry import Registry
from serve_app.app import Server
from serve_app.error_handlers import CODES, status_of
from serve_app.openapi.document import document
from serve_app.permissions import of_request
from tests.serve_app.conftest import QUICK

ROOT = Path(__file__).parents[3]
NAMES = {"model": "board", "league": "board", "version": "1", "alias": "champion", "evaluation": "1", "game": "0"}
NAMES |= {"verdict": "v", "schedule": "s", "position": "0", "run": "r"}


@pytest.fixture(scope="module")
def described() -> dict[str, Any]:
    """What a stranger is told."""
    return document(QUICK, [])


def operations(described: dict[str, Any]) -> Iterator[tuple[str, str, dict[str, Any]]]:
    for path, item in described["paths"].items():
        for method in item.keys() - {"parameters"}:
            yield path, method.upper(), item[method]


def resolved(described: dict[str, Any], node: Any) -> Any:
    while "$ref" in node:
        target = described
        for part in node["$ref"].removeprefix("#/").split("/"):
            target = target[part]
        node = target
    return node


def test_it_is_valid(described: dict[str, Any]) -> None:
    OpenAPIV31SpecValidator(described).validate()


def test_it_describes_every_route_and_no_other(described: dict[str, Any], registry: Registry) -> None:
    routes = set()
    for route in Server(registry, QUICK, "replica-1").application().routes:
        assert isinstance(route, Route | WebSocketRoute)
        if not getattr(route, "include_in_schema", True):
            continue  # the pages, which are for people
        methods = {"GET"} if isinstance(route, WebSocketRoute) else (route.methods or set()) - {"HEAD"}
        routes |= {(route.path, method) for method in methods}
    assert {(path, method) for path, method, _ in operations(described)} == routes


def test_it_names_the_scope_that_each_request_needs(described: dict[str, Any]) -> None:
    for path, method, operation in operations(described):
        kind = "websocket" if "101" in operation["responses"] else "http"
        need = of_request(kind, method, path.format(**NAMES))
        assert operation.get("x-scope") == need.scope, path
        security = operation.get("security", described["security"])
        assert security == ([] if need.scope is None else security), path
        assert ({} not in security and bool(security)) == need.is_change, path


def test_parameters_are_those_of_the_path(described: dict[str, Any]) -> None:
    for path, item in described["paths"].items():
        named = [resolved(described, each) for each in item.get("parameters", [])]
        assert [each["name"] for each in named] == re.findall(r"{(\w+)}", path)


def codes_of(described: dict[str, Any], response: Any) -> list[str]:
    schema = resolved(described, response).get("content", {}).get("application/json", {}).get("schema", {})
    parts = [part for part in schema.get("allOf", []) if "code" in part.get("properties", {})]
    return parts[0]["properties"]["code"]["enum"] if parts else []


def subclasses(error: type[LeagueError]) -> Iterator[type[LeagueError]]:
    for each in error.__subclasses__():
        yield each
        yield from subclasses(each)


def test_each_code_stands_under_its_status(described: dict[str, Any]) -> None:
    statuses = {each.code: status_of(each()) for each in subclasses(LeagueError) if each.__init__ is Exception.__init__}
    statuses |= {code: status for status, code in CODES.items()} | {"internal_error": 500, "rate_limited": 429}
    told = set()
    for path, _, operation in operations(described):
        for status, response in operation["responses"].items():
            for code in codes_of(described, response):
                assert statuses[code] == int(status), (path, code)
                told.add(code)
    serving = {error.code for error in subclasses(LeagueError) if error.__module__ == "serve_app.error_handlers"}
    assert serving <= told
    assert {"invalid_state", "version_retired", "overloaded", "rate_limited", "alias_moved"} <= told


def test_general_examples_fit_their_schemas(described: dict[str, Any]) -> None:
    """Whether a policy takes them is another question: they are of no league."""
    seen = 0
    for _, _, operation in operations(described):
        content = operation.get("requestBody", {}).get("content", {}).get("application/json")
        for example in (content or {}).get("examples", {}).values():
            schema = content["schema"] | {"components": described["components"]}
            Draft202012Validator(schema).validate(example["value"])
            seen += 1
    assert seen > 8


def test_examples_of_answers_fit_their_schemas(described: dict[str, Any]) -> None:
    seen = 0
    for _, _, operation in operations(described):
        content = operation["responses"].get("200", {}).get("content", {}).get("application/json", {})
        for example in content.get("examples", {}).values():
            schema = content["schema"] | {"components": described["components"]}
            Draft202012Validator(schema).validate(resolved(described, example)["value"])
            seen += 1
    assert seen > 8


def test_it_says_the_limits(described: dict[str, Any]) -> None:
    assert f"{QUICK.max_body:,} bytes and {QUICK.max_batch} observations" in described["info"]["description"]
    batch = described["components"]["schemas"]["ActionRequest"]["properties"]["observations"]
    assert batch["maxItems"] == QUICK.max_batch


def test_what_is_described_once_is_not_changed(described: dict[str, Any], unchanging: TestClient) -> None:
    assert unchanging.get("/openapi.json").json() != described
    assert document(QUICK, []) == described


def test_the_page_on_http_has_the_same_codes(described: dict[str, Any]) -> None:
    text = (ROOT / "docs" / "http.md").read_text()
    rows = re.findall(r"^\| (\d{3}) \| (.*) \|$", text, flags=re.M)
    written = {(int(status), code) for status, codes in rows for code in re.findall(r"`([a-z_]+)`", codes)}
    told = {
        (int(status), code)
        for _, _, operation in operations(described)
        for status, response in operation["responses"].items()
        for code in codes_of(described, response)
    }
    assert written == told | {(405, "method_not_allowed")}
