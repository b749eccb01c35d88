"""Writing of a version, over HTTP."""

from collections.abc import Iterator
from typing import Any

import pytest
from starlette.testclient import TestClient

from league.registry.registry import Registry
from tests.serve_app.conftest import replica

NOTE = "/v1/leagues/board/versions/2/note"


@pytest.fixture
def writer(registry: Registry) -> Iterator[TestClient]:
    """A client with a key that may write."""
    _, token = registry.create_key("ada", ["read", "promote"])
    with replica(registry.storage) as client:
        client.headers["authorization"] = f"Bearer {token}"
        yield client


def test_it_is_in_the_versions_with_the_keys_name(writer: TestClient) -> None:
    reply = writer.put(NOTE, json={"note": "<b>bold</b>"})
    assert reply.status_code == 200
    written = reply.json()["note"]
    assert (reply.json()["version"], written["text"], written["actor"]) == (2, "<b>bold</b>", "ada")
    versions = writer.get("/v1/leagues/board/versions").json()["versions"]
    assert [version["note"] for version in versions] == [None, written, None]
    assert writer.put(NOTE, json={"note": ""}).json()["note"] is None
    assert writer.put("/v1/leagues/board/versions/champion/note", json={"note": "leads"}).json()["version"] == 1


@pytest.mark.parametrize(
    ("path", "body", "status", "words"),
    [
        (NOTE, {}, 400, "note"),
        (NOTE, {"note": 3}, 400, "note"),
        (NOTE, {"note": "x" * 2001}, 400, "note"),
        (NOTE, {"note": "a\0b"}, 400, "note"),
        (NOTE, {"note": "x", "actor": "root"}, 400, "actor"),
        (NOTE, [], 400, ""),
        ("/v1/leagues/board/versions/99/note", {"note": "x"}, 404, "no version 99"),
        ("/v1/leagues/board/versions/nobody/note", {"note": "x"}, 404, "no alias 'nobody'"),
        ("/v1/leagues/board/versions/%00/note", {"note": "x"}, 400, ""),
        ("/v1/leagues/chess/versions/1/note", {"note": "x"}, 404, "chess"),
    ],
)
def test_what_cannot_be_written_is_refused(
    writer: TestClient, registry: Registry, path: str, body: Any, status: int, words: str
) -> None:
    reply = writer.put(path, json=body)
    assert reply.status_code == status, reply.text
    assert words in reply.json()["message"]
    assert [row.note for row in registry.versions("board")] == [None, None, None]


def test_it_is_signed_where_nothing_else_needs_a_key(client: TestClient, registry: Registry) -> None:
    assert client.put(NOTE, json={"note": "x"}).status_code == 401
    assert registry.version("board", 2).note is None


def test_a_key_for_something_else_will_not_do(registry: Registry) -> None:
    _, token = registry.create_key("reader", ["read", "act", "evaluate"])
    with replica(registry.storage) as client:
        reply = client.put(NOTE, json={"note": "x"}, headers={"authorization": f"Bearer {token}"})
    assert (reply.status_code, reply.json()["code"]) == (403, "forbidden")
    assert registry.version("board", 2).note is None
