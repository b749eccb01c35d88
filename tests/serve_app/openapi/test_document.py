"""The OpenAPI document is valid and describes all routes with their scopes and error codes."""

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
from serve_app.access.errors import CODES, status_of
from serve_app.access.permissions import Permissions
from serve_app.app import Replica
from serve_app.openapi.document import document
from serve_app.routes.table import ROUTES
from serve_app.runtime import haproxy_script
from serve_app.settings import OWN_PATHS
from tests.support.servers.replicas import QUICK

ROOT = Path(__file__).parents[3]
NAMES = {"model": "board", "league": "board", "version": "1", "alias": "champion", "evaluation": "1", "game": "0"}
NAMES |= {"verdict": "v", "schedule": "s", "position": "0", "run": "r"}


@pytest.fixture(scope="module")
def openapi() -> dict[str, Any]:
    """The document without examples of served policies."""
    return document(QUICK, [])


def operations(openapi: dict[str, Any]) -> Iterator[tuple[str, str, dict[str, Any]]]:
    for path, item in openapi["paths"].items():
        for method in item.keys() - {"parameters"}:
            yield path, method.upper(), item[method]


def resolved(openapi: dict[str, Any], node: Any) -> Any:
    while "$ref" in node:
        target = openapi
        for part in node["$ref"].removeprefix("#/").split("/"):
            target = target[part]
        node = target
    return node


def test_it_is_valid(openapi: dict[str, Any]) -> None:
    OpenAPIV31SpecValidator(openapi).validate()


def test_it_describes_exactly_the_routes(openapi: dict[str, Any], registry: Registry) -> None:
    routes = set()
    for route in Replica(registry, QUICK, "replica-1").application().routes:
        assert isinstance(route, Route | WebSocketRoute)
        if not getattr(route, "include_in_schema", True):
            continue  # web pages
        methods = {"GET"} if isinstance(route, WebSocketRoute) else (route.methods or set()) - {"HEAD"}
        routes |= {(route.path, method) for method in methods}
    assert {(path, method) for path, method, _ in operations(openapi)} == routes


def test_its_server_is_below_the_root_path(openapi: dict[str, Any]) -> None:
    assert openapi["servers"] == [{"url": "/"}]
    assert document(QUICK.model_copy(update={"root_path": "/ai"}), [])["servers"] == [{"url": "/ai"}]


def test_settings_know_the_first_segments_of_all_paths(registry: Registry) -> None:
    routes = Replica(registry, QUICK, "replica-1").application().routes
    assert {route.path.split("/")[1] for route in routes if isinstance(route, Route | WebSocketRoute)} == {
        "",
        *OWN_PATHS,
    }


def test_it_names_the_required_scope_of_each_operation(openapi: dict[str, Any]) -> None:
    permissions = Permissions(ROUTES)
    for path, method, operation in operations(openapi):
        kind = "websocket" if "101" in operation["responses"] else "http"
        need = permissions.for_request(kind, method, path.format(**NAMES))
        assert operation.get("x-scope") == need.scope, path
        security = operation.get("security", openapi["security"])
        assert security == ([] if need.scope is None else security), path
        assert ({} not in security and bool(security)) == need.is_change, path


def test_parameters_are_those_of_the_path(openapi: dict[str, Any]) -> None:
    for path, item in openapi["paths"].items():
        named = [resolved(openapi, each) for each in item.get("parameters", [])]
        assert [each["name"] for each in named] == re.findall(r"{(\w+)}", path)


def codes_of(openapi: dict[str, Any], response: Any) -> list[str]:
    schema = resolved(openapi, response).get("content", {}).get("application/json", {}).get("schema", {})
    parts = [part for part in schema.get("allOf", []) if "code" in part.get("properties", {})]
    return parts[0]["properties"]["code"]["enum"] if parts else []


def subclasses(error: type[LeagueError]) -> Iterator[type[LeagueError]]:
    for each in error.__subclasses__():
        yield each
        yield from subclasses(each)


def test_each_code_is_listed_under_its_status(openapi: dict[str, Any]) -> None:
    statuses = {each.code: status_of(each()) for each in subclasses(LeagueError) if each.__init__ is Exception.__init__}
    statuses |= {code: status for status, code in CODES.items()} | {"internal_error": 500, "rate_limited": 429}
    documented = set()
    for path, _, operation in operations(openapi):
        for status, response in operation["responses"].items():
            for code in codes_of(openapi, response):
                assert statuses[code] == int(status), (path, code)
                documented.add(code)
    serving = {error.code for error in subclasses(LeagueError) if error.__module__ == "serve_app.access.errors"}
    assert serving <= documented
    assert {"invalid_state", "version_retired", "overloaded", "rate_limited", "alias_moved"} <= documented


def test_general_examples_fit_their_schemas(openapi: dict[str, Any]) -> None:
    """These examples belong to no league, so that they are only checked against the schemas."""
    count = 0
    for _, _, operation in operations(openapi):
        content = operation.get("requestBody", {}).get("content", {}).get("application/json")
        for example in (content or {}).get("examples", {}).values():
            schema = content["schema"] | {"components": openapi["components"]}
            Draft202012Validator(schema).validate(example["value"])
            count += 1
    assert count > 8


def test_examples_of_responses_fit_their_schemas(openapi: dict[str, Any]) -> None:
    count = 0
    for _, _, operation in operations(openapi):
        content = operation["responses"].get("200", {}).get("content", {}).get("application/json", {})
        for example in content.get("examples", {}).values():
            schema = content["schema"] | {"components": openapi["components"]}
            Draft202012Validator(schema).validate(resolved(openapi, example)["value"])
            count += 1
    assert count > 8


def test_it_contains_the_limits(openapi: dict[str, Any]) -> None:
    assert f"{QUICK.max_body:,} bytes and {QUICK.max_batch} observations" in openapi["info"]["description"]
    batch = openapi["components"]["schemas"]["ActionRequest"]["properties"]["observations"]
    assert batch["maxItems"] == QUICK.max_batch


def test_the_cached_source_is_not_modified(openapi: dict[str, Any], read_only_client: TestClient) -> None:
    assert read_only_client.get("/openapi.json").json() != openapi
    assert document(QUICK, []) == openapi


def test_docs_http_md_lists_the_same_codes(openapi: dict[str, Any]) -> None:
    text = (ROOT / "docs" / "http.md").read_text()
    rows = re.findall(r"^\| (\d{3}) \| (.*) \|$", text, flags=re.M)
    written = {(int(status), code) for status, codes in rows for code in re.findall(r"`([a-z_]+)`", codes)}
    documented = {
        (int(status), code)
        for _, _, operation in operations(openapi)
        for status, response in operation["responses"].items()
        for code in codes_of(openapi, response)
    }
    of_haproxy = {(status, code) for status, (_, code, _) in haproxy_script.ERRORS.items()}
    assert written == documented | of_haproxy | {(405, "method_not_allowed")}


def test_the_errors_of_haproxy_are_described(openapi: dict[str, Any]) -> None:
    for status, (_, code, _) in haproxy_script.ERRORS.items():
        assert f"{status} `{code}`" in openapi["info"]["description"]
