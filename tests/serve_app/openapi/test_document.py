"""The OpenAPI document is valid, and describes all routes with their scopes, error codes and valid examples."""

import json
import re
from base64 import b64encode
from collections import Counter
from collections.abc import Iterator
from hashlib import sha256
from pathlib import Path
from types import WrapperDescriptorType
from typing import Any

import numpy as np
import pytest
from jsonschema import Draft202012Validator
from openapi_spec_validator import OpenAPIV31SpecValidator
from starlette.routing import Route, WebSocketRoute
from starlette.testclient import TestClient

from league.errors import LeagueError
from league.registry.registry import Registry
from league.settings import Storage
from league.spaces import Box, DictSpace, Discrete, MultiBinary, MultiDiscrete, Space
from league.spaces.observation_codec import ObservationReader
from serve_app.access.errors import CODES, status_of
from serve_app.access.permissions import Permissions
from serve_app.app import Replica
from serve_app.openapi.document import document, observation
from serve_app.routes.table import ROUTES
from serve_app.runtime import haproxy_script
from serve_app.settings import OWN_PATHS
from tests.support.leagues.protocol_leagues import every_kind
from tests.support.leagues.served_leagues import promote
from tests.support.servers.replicas import QUICK, replica
from tests.support.waiting import until

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


def test_it_is_valid(openapi: dict[str, Any], read_only_client: TestClient) -> None:
    OpenAPIV31SpecValidator(openapi).validate()
    assert openapi["servers"] == [{"url": "/"}]
    assert document(QUICK.model_copy(update={"root_path": "/ai"}), [])["servers"] == [{"url": "/ai"}]
    assert f"{QUICK.max_body:,} bytes and {QUICK.max_batch} observations" in openapi["info"]["description"]
    batch = openapi["components"]["schemas"]["ActionRequest"]["properties"]["observations"]
    assert batch["maxItems"] == QUICK.max_batch
    for status, (_, code, _) in haproxy_script.ERRORS.items():
        assert f"{status} `{code}`" in openapi["info"]["description"]
    reply = read_only_client.get("/openapi.json")
    assert (reply.status_code, reply.headers["content-type"]) == (200, "application/json")
    assert reply.json()["openapi"].startswith("3.1.")
    assert reply.json() != openapi
    assert document(QUICK, []) == openapi, "the cached source is not modified"


def test_it_describes_exactly_the_routes(openapi: dict[str, Any], registry: Registry) -> None:
    routes, segments = set(), set()
    for route in Replica(registry, QUICK, "replica-1").application().routes:
        assert isinstance(route, Route | WebSocketRoute)
        segments.add(route.path.split("/")[1])
        if getattr(route, "include_in_schema", True):  # no web page
            methods = {"GET"} if isinstance(route, WebSocketRoute) else (route.methods or set()) - {"HEAD"}
            routes |= {(route.path, method) for method in methods}
    assert {(path, method) for path, method, _ in operations(openapi)} == routes
    assert segments == {"", *OWN_PATHS}, "settings know them"
    for path, item in openapi["paths"].items():
        parameters = [resolved(openapi, parameter)["name"] for parameter in item.get("parameters", [])]
        assert parameters == re.findall(r"{(\w+)}", path)


def test_it_names_the_required_scope_of_each_operation(openapi: dict[str, Any]) -> None:
    permissions = Permissions(ROUTES)
    for path, method, operation in operations(openapi):
        kind = "websocket" if "101" in operation["responses"] else "http"
        need = permissions.for_request(kind, method, path.format(**NAMES))
        assert operation.get("x-scope") == need.scope, path
        security = operation.get("security", openapi["security"])
        assert security == ([] if need.scope is None else security), path
        assert ({} not in security and bool(security)) == need.is_change, path


def codes_of(openapi: dict[str, Any], response: Any) -> list[str]:
    schema = resolved(openapi, response).get("content", {}).get("application/json", {}).get("schema", {})
    parts = [part for part in schema.get("allOf", []) if "code" in part.get("properties", {})]
    return parts[0]["properties"]["code"]["enum"] if parts else []


def subclasses(error: type[LeagueError]) -> Iterator[type[LeagueError]]:
    for subclass in error.__subclasses__():
        yield subclass
        yield from subclasses(subclass)


def test_each_code_is_listed_under_its_status(openapi: dict[str, Any]) -> None:
    statuses = {
        error.code: status_of(error())
        for error in subclasses(LeagueError)
        if isinstance(error.__init__, WrapperDescriptorType)  # that of Exception or of ValueError
    }
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


def test_examples_fit_their_schemas(openapi: dict[str, Any]) -> None:
    """These examples belong to no league, so that they are only checked against the schemas."""
    counts = Counter[str]()
    for _, _, operation in operations(openapi):
        for part, owner in (
            ("request", operation.get("requestBody", {})),
            ("response", operation["responses"].get("200", {})),
        ):
            content = owner.get("content", {}).get("application/json", {})
            for example in content.get("examples", {}).values():
                schema = content["schema"] | {"components": openapi["components"]}
                Draft202012Validator(schema).validate(resolved(openapi, example)["value"])
                counts[part] += 1
    assert min(counts["request"], counts["response"]) > 8


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


@pytest.fixture(scope="module")
def kinds(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    storage = Storage.at(tmp_path_factory.mktemp("kinds"))
    every_kind(storage).close()
    with replica(storage, QUICK) as client:
        yield client


def examples(client: TestClient, path: str) -> dict[str, Any]:
    post = client.get("/openapi.json").json()["paths"][path]["post"]
    every = post["requestBody"]["content"]["application/json"]["examples"].values()
    return {example["x-model"]: example["value"] for example in every if "x-model" in example}


def test_each_served_policy_has_a_valid_action_example(kinds: TestClient) -> None:
    examples_of_models = examples(kinds, "/v1/policies/{model}/action")
    assert set(examples_of_models) == {
        *("board", "memory", "vector", "nested", "kinds", "chess", "pistons", "choice", "duo.left", "duo.right")
    }
    for model, body in examples_of_models.items():
        reply = kinds.post(f"/v1/policies/{model}/action", json=body)
        assert reply.status_code == 200, (model, reply.text)
    assert "png" in examples_of_models["pistons"]["observation"]
    assert "b64" in examples_of_models["chess"]["observation"]["observation"]
    assert "state" in examples_of_models["memory"]


@pytest.mark.parametrize("at", ["", "/versions/{version}"])
def test_policies_with_small_inputs_have_a_valid_inference_example(kinds: TestClient, at: str) -> None:
    examples_of_models = examples(kinds, "/v2/models/{model}" + at + "/infer")
    assert {"board", "kinds", "duo.left"} <= set(examples_of_models)
    assert not {"chess", "pistons"} & set(examples_of_models)
    for model, body in examples_of_models.items():
        reply = kinds.post("/v2/models/" + model + at.format(version=1) + "/infer", json=body)
        assert reply.status_code == 200, (model, reply.text)


SPACES: tuple[Space, ...] = (
    Box(dtype="float32", shape=(2,), low=[1.0, None], high=[2.0, None]),
    Box(dtype="int16", shape=(), low=-5, high=-2),
    Box(dtype="uint8", shape=(30, 30), low=0, high=255),
    Box(dtype="uint8", shape=(20, 20, 3), low=0, high=255),
    Box(dtype="uint8", shape=(20, 20, 5), low=0, high=255),
    Box(dtype="float64", shape=(600,), low=None, high=None),
    Discrete(n=3, start=-4),
    MultiDiscrete(nvec=[2, 3], start=[5, 6], shape=(2,)),
    MultiBinary(shape=(3,)),
    DictSpace(spaces={"a": Discrete(n=2, start=1), "b": DictSpace(spaces={"c": MultiBinary(shape=(2,))})}),
)


def test_an_example_is_in_its_space() -> None:
    for space in SPACES:
        arrays = ObservationReader(space).read([observation(space)])
        if isinstance(space, Box):
            low = np.array(-np.inf if space.low is None else space.low, float)
            assert (arrays["observation"] >= np.nan_to_num(low, nan=-np.inf)).all()


def test_the_page_loads_no_other_resources_and_runs_its_own_script_only(read_only_client: TestClient) -> None:
    reply = read_only_client.get("/docs")
    assert (reply.status_code, reply.headers["content-type"]) == (200, "text/html; charset=utf-8")
    assert not re.findall(r"https?://|\bsrc=|@import|\burl\(|\bimport\(", reply.text)
    assert "openapi.json" in reply.text
    rules = reply.headers["content-security-policy"]
    (script,) = re.findall(r"<script>(.*?)</script>", reply.text, re.DOTALL)
    assert f"script-src 'sha256-{b64encode(sha256(script.encode()).digest()).decode()}';" in rules
    assert "default-src 'none'" in rules
    assert "innerHTML" not in script, "content must be inserted as text"
    assert not re.findall(r"\son\w+=", reply.text.replace(script, "")), "the policy forbids inline handlers"


def test_examples_require_permission_to_read(client: TestClient, registry: Registry) -> None:
    def is_shown(token: str | None = None) -> bool:
        headers = {} if token is None else {"x-api-key": token}
        content = client.get("/openapi.json", headers=headers).json()
        for name in ("Playability", "PlayableAgent"):  # a property `board`, and KeyboardEvent
            del content["components"]["schemas"][name]
        return re.search("(?<![Ll]eader)board", json.dumps(content)) is not None

    assert is_shown()
    _, reader = registry.keys.create("reader", ["read"])
    _, actor = registry.keys.create("actor", ["act"])
    _, of_one = registry.keys.create("of-one", ["read"], only_leagues=["board"])
    until(lambda: not is_shown())
    until(lambda: is_shown(reader))
    assert not is_shown()
    assert client.get("/docs").status_code == 200
    assert client.get("/v1/leagues").status_code == 401
    assert not is_shown("plk_wrong")
    assert not is_shown(actor)
    assert not is_shown(of_one), "the examples cover all leagues"


def test_examples_follow_the_served_versions(client: TestClient, registry: Registry) -> None:
    assert "of_headless" not in client.get("/openapi.json").text
    promote(registry, "headless", 1)
    until(lambda: "of_headless" in client.get("/openapi.json").text)
