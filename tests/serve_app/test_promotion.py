"""Promotions and rollbacks over HTTP."""

import json
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import httpx
import pytest
from sqlalchemy import text
from starlette.testclient import TestClient

from league.registry.registry import Registry
from tests.support.databases import on_both_databases
from tests.support.leagues.served_leagues import promote
from tests.support.servers.replicas import replica

CHAMPION = "/v1/leagues/board/aliases/champion"
ROLLBACK = "/v1/leagues/board/rollback"


@contextmanager
def promoting(registry: Registry) -> Iterator[TestClient]:
    """A client with a key that may promote."""
    _, token = registry.keys.create("release-bot", ["promote"])
    with replica(registry.storage) as client:
        client.headers["authorization"] = f"Bearer {token}"
        yield client


@pytest.fixture
def promoter(registry: Registry) -> Iterator[TestClient]:
    with promoting(registry) as client:
        yield client


@pytest.fixture(scope="module")
def shared_promoter(shared_registry: Registry) -> Iterator[TestClient]:
    with promoting(shared_registry) as client:
        yield client


def change(client: TestClient, path: str, key: str, body: Any = None, status: int = 200) -> dict[str, Any]:
    content = body if isinstance(body, bytes) else json.dumps(body or {}).encode()
    reply = client.post(path, content=content, headers={"idempotency-key": key})
    assert reply.status_code == status, reply.text
    return reply.json()


@on_both_databases
def test_a_promotion_is_in_the_history_with_the_name_of_the_key(promoter: TestClient, registry: Registry) -> None:
    event = change(promoter, CHAMPION, "a", {"version": 2, "expected": 1, "reason": "it is stronger"})
    assert event.pop("at")
    assert event.pop("event")
    assert event == {
        "league": "board",
        "alias": "champion",
        "kind": "set",
        "version": 2,
        "previous": 1,
        "actor": "release-bot",
        "reason": "it is stronger",
        "verdict": None,
    }
    newest = registry.aliases.history("board")[0]
    assert (newest.version, newest.actor, newest.reason) == (2, "release-bot", "it is stronger")


@on_both_databases
def test_a_rollback_returns_to_the_previous_champion(promoter: TestClient, registry: Registry) -> None:
    promote(registry, "board", 2)
    event = change(promoter, ROLLBACK, "a")
    assert (event["kind"], event["version"], event["previous"]) == ("rollback", 1, 2)


@on_both_databases
def test_a_rollback_of_another_version_changes_nothing(promoter: TestClient, registry: Registry) -> None:
    """Two people who roll back the same version do not go back twice."""
    for version in (2, 3):
        promote(registry, "board", version)
    assert change(promoter, ROLLBACK, "a", {"expected": 3})["version"] == 2
    error = change(promoter, ROLLBACK, "b", {"expected": 3}, 409)
    assert (error["code"], registry.aliases.current("board")["champion"]) == ("alias_moved", 2)
    assert change(promoter, ROLLBACK, "c", {"expected": None})["version"] == 1


@on_both_databases
def test_a_repeated_call_changes_nothing(promoter: TestClient, registry: Registry) -> None:
    promote(registry, "board", 2)
    promote(registry, "board", 3)
    first = change(promoter, ROLLBACK, "a", {"reason": "it lost"})
    assert change(promoter, ROLLBACK, "a", b' { "reason" : "it lost" } ') == first
    assert registry.aliases.current("board")["champion"] == 2
    error = change(promoter, ROLLBACK, "a", {"reason": "it lost again"}, 409)
    assert error["code"] == "idempotency_key_reused"
    assert change(promoter, CHAMPION, "a", {"version": 3}, 409)["code"] == "idempotency_key_reused"
    assert registry.aliases.current("board")["champion"] == 2


@on_both_databases
def test_concurrent_calls_are_applied_once(promoter: TestClient, registry: Registry) -> None:
    for version in (2, 3):
        promote(registry, "board", version)
    with ThreadPoolExecutor(8) as pool:
        events = list(pool.map(lambda _: change(promoter, ROLLBACK, "a")["event"], range(8)))
    assert len(set(events)) == 1
    assert registry.aliases.current("board")["champion"] == 2


@on_both_databases
def test_the_expected_version_is_checked(promoter: TestClient, registry: Registry) -> None:
    assert change(promoter, CHAMPION, "a", {"version": 2, "expected": 3}, 409)["code"] == "alias_moved"
    assert change(promoter, CHAMPION, "b", {"version": 2, "expected": None}, 409)["code"] == "alias_moved"
    path = "/v1/leagues/board/aliases/candidate"
    assert change(promoter, path, "c", {"version": 3, "expected": None})["previous"] is None
    assert registry.aliases.current("board") == {"champion": 1, "candidate": 3}
    change(promoter, ROLLBACK, "d", status=409)


@on_both_databases
def test_a_mixture_is_published_once_and_promoted(promoter: TestClient, registry: Registry) -> None:
    members = [{"version": 3, "probability": 0.4}, {"version": 1, "probability": 0.6}]
    event = change(promoter, CHAMPION, "a", {"members": members, "expected": 1})
    assert (event["version"], event["previous"]) == (4, 1)
    assert change(promoter, CHAMPION, "a", {"members": members, "expected": 1}) == event
    assert change(promoter, "/v1/leagues/board/aliases/candidate", "b", {"members": members})["version"] == 4
    assert change(promoter, ROLLBACK, "c", {"expected": 4})["version"] == 1


@pytest.mark.parametrize(
    ("path", "body", "status", "message"),
    [
        (CHAMPION, {}, 400, "version"),
        (CHAMPION, {"version": "2"}, 400, "version"),
        (CHAMPION, {"version": 0}, 400, "version"),
        (CHAMPION, {"version": 2**40}, 400, "version"),
        (CHAMPION, {"version": 2, "actor": "root"}, 400, "actor"),
        (CHAMPION, {"version": 2, "reason": "a\0b"}, 400, "reason"),
        (CHAMPION, b'{"version": 2, "reason": "\\ud800"}', 400, ""),
        (CHAMPION, b"\xff", 400, ""),
        (CHAMPION, b"[" * 100_00, 400, ""),
        (CHAMPION, b" " * 70_000, 413, "larger"),
        (CHAMPION, {"version": 99}, 404, "99"),
        (CHAMPION, {"version": 2, "members": [{"version": 2, "probability": 1.0}]}, 400, "either version, or members"),
        (CHAMPION, {"members": [{"version": 2, "probability": 1.0}]}, 400, "expected at least two"),
        (CHAMPION, {"members": [{"version": 2, "probability": 0.5}] * 2}, 400, "named twice"),
        (CHAMPION, {"members": [{"version": n, "probability": 0.3} for n in (1, 2)]}, 400, "sum to 0.6"),
        (CHAMPION, {"members": [{"version": n, "probability": 0.5} for n in (1, 99)]}, 404, "99"),
        (CHAMPION, {"members": [{"version": 2}]}, 400, "probability"),
        (ROLLBACK, {"version": 1}, 400, "version"),
        ("/v1/leagues/chess/rollback", {}, 404, "chess"),
        ("/v1/leagues/board/aliases/12", {"version": 2}, 400, "12"),
        ("/v1/leagues/board/aliases/A%00", {"version": 2}, 400, "alias"),
    ],
)
def test_invalid_changes_are_rejected(
    shared_promoter: TestClient, shared_registry: Registry, path: str, body: Any, status: int, message: str
) -> None:
    history = shared_registry.aliases.history("board")
    assert message in change(shared_promoter, path, "a", body, status)["message"]
    assert shared_registry.aliases.history("board") == history


@pytest.mark.parametrize("key", [None, "", "x" * 256, "a\tb", "é"])
def test_a_call_requires_an_idempotency_key(
    shared_promoter: TestClient, shared_registry: Registry, key: str | None
) -> None:
    headers = [] if key is None else [(b"idempotency-key", key.encode())]
    reply = shared_promoter.post(CHAMPION, json={"version": 2}, headers=headers)  # type: ignore[arg-type]
    assert (reply.status_code, reply.json()["code"]) == (400, "invalid_input")
    assert "Idempotency-Key" in reply.json()["message"]
    assert shared_registry.aliases.current("board")["champion"] == 1


def test_changes_always_require_a_key(client: TestClient, registry: Registry) -> None:
    def attempt(**headers: str) -> httpx.Response:
        return client.post(ROLLBACK, json={}, headers={"idempotency-key": "a"} | headers)

    assert client.get("/v1/leagues").status_code == 200, "other routes need no key"
    reply = attempt()
    assert (reply.status_code, reply.json()["code"]) == (401, "unauthenticated")
    assert "league keys create NAME --scope promote" in reply.json()["message"]
    assert registry.aliases.current("board")["champion"] == 1


@contextmanager
def locked(registry: Registry) -> Iterator[None]:
    """Another connection is changing the database."""
    with registry.database.write() as session:
        session.execute(text("UPDATE leagues SET slug = slug"))
        yield


@on_both_databases
def test_a_change_that_timed_out_is_not_applied_later(promoter: TestClient, registry: Registry) -> None:
    headers = {"idempotency-key": "late", "x-request-timeout-ms": "300"}
    with locked(registry):
        reply = promoter.post(CHAMPION, json={"version": 2}, headers=headers)
        assert reply.status_code in (503, 504), reply.text
    assert promoter.get("/v1/health/ready").status_code == 200
    change(promoter, CHAMPION, "next", {"version": 3, "expected": 1})
    assert [event.version for event in registry.aliases.history("board")] == [3, 1]


@on_both_databases
def test_waiting_changes_do_not_delay_reading(registry: Registry) -> None:
    _, token = registry.keys.create("operator", ["promote", "read"])
    with replica(registry.storage) as client, ThreadPoolExecutor(8) as pool:
        client.headers["authorization"] = f"Bearer {token}"

        def call(number: int) -> int:
            headers = {"idempotency-key": str(number), "x-request-timeout-ms": "1500"}
            return client.post(CHAMPION, json={"version": 2}, headers=headers).status_code

        with locked(registry):
            waiting = [pool.submit(call, number) for number in range(8)]
            assert client.get("/v1/leagues/board").status_code == 200
            assert not all(each.done() for each in waiting)
        assert {each.result() for each in waiting} <= {200, 503, 504}
