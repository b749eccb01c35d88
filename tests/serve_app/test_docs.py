"""The OpenAPI document and its page need no key, load no other resources, and reveal no leagues without a key."""

import json
import re
from base64 import b64encode
from hashlib import sha256

import pytest
from starlette.testclient import TestClient

from league.registry.registry import Registry
from tests.support.leagues.served_leagues import promote
from tests.support.waiting import until


def test_the_page_loads_no_other_resources(read_only_client: TestClient) -> None:
    reply = read_only_client.get("/docs")
    assert (reply.status_code, reply.headers["content-type"]) == (200, "text/html; charset=utf-8")
    assert not re.findall(r"https?://|\bsrc=|@import|\burl\(|\bimport\(", reply.text)
    assert "openapi.json" in reply.text


def test_the_page_can_run_its_own_script_only(read_only_client: TestClient) -> None:
    reply = read_only_client.get("/docs")
    rules = reply.headers["content-security-policy"]
    (script,) = re.findall(r"<script>(.*?)</script>", reply.text, re.DOTALL)
    assert f"script-src 'sha256-{b64encode(sha256(script.encode()).digest()).decode()}';" in rules
    assert "default-src 'none'" in rules
    assert "innerHTML" not in script, "content must be inserted as text"
    assert not re.findall(r"\son\w+=", reply.text.replace(script, "")), "the policy forbids inline handlers"


def test_openapi_json_is_a_document(read_only_client: TestClient) -> None:
    reply = read_only_client.get("/openapi.json")
    assert (reply.status_code, reply.headers["content-type"]) == (200, "application/json")
    assert reply.json()["openapi"].startswith("3.1.")


@pytest.mark.parametrize("path", ["/docs", "/openapi.json"])
def test_both_need_no_key(client: TestClient, registry: Registry, path: str) -> None:
    registry.keys.create("bot", ["read"])
    until(lambda: client.get("/v1/leagues").status_code == 401)
    assert client.get(path).status_code == 200


def test_examples_require_permission_to_read(client: TestClient, registry: Registry) -> None:
    def is_shown(token: str | None = None) -> bool:
        headers = {} if token is None else {"x-api-key": token}
        shown = client.get("/openapi.json", headers=headers).json()
        for name in ("Playability", "PlayableAgent"):  # a property `board`, and KeyboardEvent
            del shown["components"]["schemas"][name]
        return re.search("(?<![Ll]eader)board", json.dumps(shown)) is not None

    assert is_shown()
    _, reader = registry.keys.create("reader", ["read"])
    _, actor = registry.keys.create("actor", ["act"])
    _, of_one = registry.keys.create("of-one", ["read"], only_leagues=["board"])
    until(lambda: not is_shown())
    until(lambda: is_shown(reader))
    assert not is_shown()
    assert not is_shown("plk_wrong")
    assert not is_shown(actor)
    assert not is_shown(of_one), "the examples cover all leagues"


def test_examples_follow_the_served_versions(client: TestClient, registry: Registry) -> None:
    assert "of_headless" not in client.get("/openapi.json").text
    promote(registry, "headless", 1)
    until(lambda: "of_headless" in client.get("/openapi.json").text)
