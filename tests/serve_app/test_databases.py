"""A replica answers equally whether its registry is in SQLite or in PostgreSQL.

PostgreSQL limits the length of names, has 32-bit integers and refuses NUL characters in text; SQLite has no such
limits.
"""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from schemathesis.schemas import APIOperation

from serve_app.openapi.document import document
from tests.support.generated_requests import OPERATIONS, draw_request
from tests.support.leagues.match_results import SCHEDULE, WON
from tests.support.servers.replicas import QUICK
from tests.support.servers.two_databases import ReplicasOfBoth, is_available, replicas_of_both

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
def replicas(tmp_path_factory: pytest.TempPathFactory, postgresql_socket: Path) -> Iterator[ReplicasOfBoth]:
    """Replicas of equal leagues, one for each database, with a key for all scopes."""
    with replicas_of_both(tmp_path_factory.mktemp("databases"), postgresql_socket) as replicas:
        yield replicas


def answers(replicas: ReplicasOfBoth, method: str, path: str, content: bytes | None = None) -> tuple[int, str | None]:
    """The status and the code of the error, which must be equal."""
    found = replicas.outline(method, path, content, {"idempotency-key": str(hash((path, content)))})
    assert found[0] == found[1], (method, path, content)
    return found[0][:2]


def reads() -> list[tuple[str, list[str]]]:
    """The paths that are read, and their query parameters."""
    operations = ((path, calls["get"]) for path, calls in document(QUICK, [])["paths"].items() if "get" in calls)
    return [
        (path, [each["name"] for each in call.get("parameters", []) if each.get("in") == "query"])
        for path, call in operations
        if path.startswith("/v1/leagues/") and not path.endswith("/events")
    ]


@pytest.mark.parametrize(("path", "parameters"), reads(), ids=lambda each: each if isinstance(each, str) else "")
def test_unusual_parameters(replicas: ReplicasOfBoth, path: str, parameters: list[str]) -> None:
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
def test_unusual_changes(replicas: ReplicasOfBoth, path: str) -> None:
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
def test_names_of_aliases(replicas: ReplicasOfBoth, name: str) -> None:
    """A name that one database cannot store is accepted by none."""
    body: dict[str, Any] = {"version": 2}
    status, _ = answers(replicas, "POST", f"/v1/leagues/board/aliases/{quote(name)}", json.dumps(body).encode())
    assert status == (200 if name in ("candidate", "x" * 100) else 400)


def test_replicas_are_compared_when_they_follow_a_promotion(replicas: ReplicasOfBoth) -> None:
    """They read it at different times. Until then, the index says why the version is not ready."""

    def ready() -> list[int]:
        """The number of versions that are ready, of each replica."""
        outlines = replicas.outline("POST", "/v2/repository/index", b"{}", {})
        return [sum("reason" not in version for version in index) for _, _, index in outlines]

    before = ready()
    answers(replicas, "POST", "/v1/leagues/headless/aliases/candidate", b'{"version": 1, "reason": "a test"}')
    assert ready() == [count + 1 for count in before]


def test_replicas_are_compared_when_they_have_reported(replicas: ReplicasOfBoth) -> None:
    body = json.dumps({"observation": {"mode": 1, "sense": {"speed": [1.0, 2.0]}}}).encode()
    assert answers(replicas, "POST", "/v1/policies/nested/action", body) == (200, None)
    for status, _, traffic in replicas.outline("GET", "/v1/leagues/nested/traffic", None, {}):
        assert (status, len(traffic["all"]["versions"])) == (200, 1)


@pytest.mark.parametrize("operation", OPERATIONS, ids=lambda each: each.label.replace("/", " "))
@settings(max_examples=3, deadline=None)
@given(data=st.data())
def test_generated_requests(replicas: ReplicasOfBoth, operation: APIOperation, data: st.DataObject) -> None:
    drawn = draw_request(data, operation)
    sqlite, other = replicas.outline(drawn.method, drawn.url, drawn.content, drawn.headers)
    assert sqlite == other
    assert is_available(*sqlite[:2])
