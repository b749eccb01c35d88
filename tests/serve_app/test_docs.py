"""The description and its page are open, need nothing from elsewhere, and tell strangers nothing of a league."""

import re
from base64 import b64encode
from hashlib import sha256

import pytest
from starlette.testclient import TestClient

from league.registry.registry import Registry
from tests.serve_app.leagues import promote


def test_the_page_needs_nothing_from_elsewhere(unchanging: TestClient) -> None:
    reply = unchanging.get("/docs")
    assert (reply.status_code, reply.headers["content-type"]) == (200, "text/html; charset=utf-8")
    assert not re.findall(r"https?://|\bsrc=|@import|\burl\(|\bimport\(", reply.text)
    assert "openapi.json" in reply.text


def test_the_page_may_run_its_own_script_alone(unchanging: TestClient) -> None:
    reply = unchanging.get("/docs")
    rules = reply.headers["content-security-policy"]
    (script,) = re.findall(r"<script>(.*?)</script>", reply.text, re.DOTALL)
    assert f"script-src 'sha256-{b64encode(sha256(script.encode()).digest()).decode()}';" in rules
    assert "default-src 'none'" in rules
    assert "innerHTML" not in script, "what comes from the document becomes text"
    assert not re.findall(r"\son\w+=", reply.text.replace(script, "")), "the rules forbid handlers in attributes"


def test_the_description_is_a_document(unchanging: TestClient) -> None:
    reply = unchanging.get("/openapi.json")
    assert (reply.status_code, reply.headers["content-type"]) == (200, "application/json")
    assert reply.json()["openapi"].startswith("3.1.")


@pytest.mark.parametrize("path", ["/docs", "/openapi.json"])
def test_both_are_open_where_keys_are_needed(client: TestClient, registry: Registry, path: str) -> None:
    registry.create_key("bot", ["read"])
    while client.get("/v1/leagues").status_code != 401:
        pass
    assert client.get(path).status_code == 200


def test_examples_are_for_those_who_may_look(client: TestClient, registry: Registry) -> None:
    def is_told(token: str | None = None) -> bool:
        headers = {} if token is None else {"x-api-key": token}
        return "board" in client.get("/openapi.json", headers=headers).text

    assert is_told()
    _, reader = registry.create_key("reader", ["read"])
    _, actor = registry.create_key("actor", ["act"])
    _, of_one = registry.create_key("of-one", ["read"], only_leagues=["board"])
    while is_told():
        pass
    while not is_told(reader):
        pass
    assert not is_told()
    assert not is_told("plk_wrong")
    assert not is_told(actor)
    assert not is_told(of_one), "its examples would be of all leagues"


def test_examples_follow_what_is_served(client: TestClient, registry: Registry) -> None:
    assert "of_headless" not in client.get("/openapi.json").text
    promote(registry, "headless", 1)
    while "of_headless" not in client.get("/openapi.json").text:
        pass
