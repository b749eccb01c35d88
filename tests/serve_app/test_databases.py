"""A replica answers equally whether its registry is in SQLite or in PostgreSQL.

PostgreSQL limits the length of names, has 32-bit integers and refuses NUL characters in text; SQLite has no such
limits.
"""

import json
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pytest
from starlette.testclient import TestClient

from league.settings import Storage
from serve_app.openapi.document import document
from serve_app.runtime.serve_bypass import is_event_stream
from tests.support.leagues.match_results import SCHEDULE, WON, record
from tests.support.leagues.served_leagues import build_everything
from tests.support.servers import postgresql
from tests.support.servers.replicas import QUICK, READ_ONLY, replica

UNUSUAL = ("a\0b", "x" * 101, "x" * 301, "x" * 5000, "-1", "0", str(2**31), str(2**63), "9" * 40, "é", "Board", "²")
PATH = {
    "league": "board",
    "alias": "champion",
    "version": "1",
    "evaluation": "1",
    "verdict": WON,
    "schedule": SCHEDULE.id,
    "position": "0",
    "game": "0",
    "run": "first",
}
CHANGES = {
    "/v1/leagues/board/aliases/candidate": {"version": 1, "expected": None, "reason": "a test"},
    "/v1/leagues/board/rollback": {"expected": 3, "reason": "a test"},
    "/v1/leagues/board/traffic": {"canary": {"version": 2, "share": 0.5}, "shadow": None, "reason": "a test"},
    "/v1/leagues/board/versions/1/note": {"note": "a test"},
}
VALUES = ("", "a\0b", "x" * 3000, "\ud800", "😀", 0, -1, 2**31, 2**63, 10**400, 1.5, True, None, [], {}, "1")


@pytest.fixture(scope="module")
def replicas(tmp_path_factory: pytest.TempPathFactory, postgresql_socket: Path) -> Iterator[list[TestClient]]:
    """Replicas of equal leagues, one for each database, with a key for all scopes."""
    with ExitStack() as stack:
        clients = []
        for database in ("sqlite", "postgresql"):
            storage = Storage.at(tmp_path_factory.mktemp(database))
            if database == "postgresql":
                storage = replace(storage, database_url=postgresql.create(postgresql_socket, "databases"))
            key = _fill(storage)
            clients.append(stack.enter_context(replica(storage, READ_ONLY)))
            clients[-1].headers["x-api-key"] = key
        yield clients


def _fill(storage: Storage) -> str:
    registry = build_everything(storage)
    record(registry)
    _, token = registry.keys.create("databases", ["act", "read", "evaluate", "promote"])
    registry.close()
    return token


def answers(replicas: list[TestClient], method: str, path: str, content: bytes | None = None) -> tuple[int, str | None]:
    """The status and the code of the error, which must be equal."""
    headers, found = {"idempotency-key": str(hash((path, content)))}, []
    for client in replicas:
        response = client.request(method, path, content=content, headers=headers)
        is_error = response.status_code >= 400 and "json" in response.headers["content-type"]
        found.append((response.status_code, response.json().get("code") if is_error else None))
    assert found[0] == found[1], (method, path, content)
    return found[0]


def reads() -> list[tuple[str, list[str]]]:
    """The paths that are read, and their query parameters."""
    operations = ((path, calls["get"]) for path, calls in document(QUICK, [])["paths"].items() if "get" in calls)
    return [
        (path, [each["name"] for each in call.get("parameters", []) if each.get("in") == "query"])
        for path, call in operations
        if path.startswith("/v1/leagues/") and not is_event_stream(path)
    ]


@pytest.mark.parametrize(("path", "parameters"), reads(), ids=lambda each: each if isinstance(each, str) else "")
def test_unusual_parameters(replicas: list[TestClient], path: str, parameters: list[str]) -> None:
    usual = path.format_map(PATH)
    assert answers(replicas, "GET", usual)[0] in (200, 404, 503)
    for value in UNUSUAL:
        for name in (name for name in PATH if f"{{{name}}}" in path):
            status, _ = answers(replicas, "GET", path.format_map(PATH | {name: quote(value, safe="")}))
            assert status in (200, 400, 404, 422, 503), (name, value)
        for name in parameters:
            status, _ = answers(replicas, "GET", f"{usual}?{name}={quote(value, safe='')}")
            assert status in (200, 400, 404, 503), (name, value)


@pytest.mark.parametrize("path", CHANGES)
def test_unusual_changes(replicas: list[TestClient], path: str) -> None:
    body = CHANGES[path]
    method = "PUT" if path.endswith("note") else "POST"
    for field in body:
        for value in VALUES:
            status, _ = answers(replicas, method, path, json.dumps(body | {field: value}).encode())
            assert status in (200, 400, 404, 409), (field, value)
    for value in UNUSUAL:
        changed = path.replace("board", quote(value, safe=""))
        status, _ = answers(replicas, method, changed, json.dumps(body).encode())
        assert status in (400, 404, 405), value


@pytest.mark.parametrize("name", ["candidate", "x" * 100, "x" * 101, "x" * 300, "1", "a\0b", "Ä"])
def test_names_of_aliases(replicas: list[TestClient], name: str) -> None:
    """A name that one database cannot store is accepted by none."""
    body: dict[str, Any] = {"version": 2}
    status, _ = answers(replicas, "POST", f"/v1/leagues/board/aliases/{quote(name)}", json.dumps(body).encode())
    assert status == (200 if name in ("candidate", "x" * 100) else 400)
