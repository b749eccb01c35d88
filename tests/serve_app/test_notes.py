"""Notes on versions, over HTTP."""

from collections.abc import Iterator
from typing import Any

import pytest
from starlette.testclient import TestClient

from league.registry.registry import Registry
from tests.support.servers.replicas import replica

NOTE = "/v1/leagues/board/versions/2/note"


@pytest.fixture
def writer(registry: Registry) -> Iterator[TestClient]:
    """A client with a key that may write notes."""
    _, token = registry.keys.create("ada", ["read", "promote"])
    with replica(registry.storage) as client:
        client.headers["authorization"] = f"Bearer {token}"
        yield client


def test_a_note_is_in_the_versions_with_the_name_of_the_key(writer: TestClient) -> None:
    reply = writer.put(NOTE, json={"note": "<b>bold</b>"})
    assert reply.status_code == 200
    written = reply.json()["note"]
    assert (reply.json()["version"], written["text"], written["actor"]) == (2, "<b>bold</b>", "ada")
    versions = writer.get("/v1/leagues/board/versions").json()["versions"]
    assert [version["note"] for version in versions] == [None, written, None]
    assert writer.put(NOTE, json={"note": ""}).json()["note"] is None
    assert writer.put("/v1/leagues/board/versions/champion/note", json={"note": "leads"}).json()["version"] == 1


@pytest.mark.parametrize(
    ("path", "body", "status", "message"),
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
def test_an_invalid_note_is_rejected(
    writer: TestClient, registry: Registry, path: str, body: Any, status: int, message: str
) -> None:
    reply = writer.put(path, json=body)
    assert reply.status_code == status, reply.text
    assert message in reply.json()["message"]
    assert [row.note for row in registry.versions.all("board")] == [None, None, None]


def test_notes_always_require_a_key(client: TestClient, registry: Registry) -> None:
    assert client.put(NOTE, json={"note": "x"}).status_code == 401
    assert registry.versions.get("board", 2).note is None


def test_a_key_with_other_scopes_is_rejected(registry: Registry) -> None:
    _, token = registry.keys.create("reader", ["read", "act", "evaluate"])
    with replica(registry.storage) as client:
        reply = client.put(NOTE, json={"note": "x"}, headers={"authorization": f"Bearer {token}"})
    assert (reply.status_code, reply.json()["code"]) == (403, "forbidden")
    assert registry.versions.get("board", 2).note is None
