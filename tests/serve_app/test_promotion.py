"""Leagues, versions and their notes are listed; promotions and rollbacks over HTTP."""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import pytest
from sqlalchemy import text
from starlette.testclient import TestClient

from league.registry.registry import Registry
from league.settings import Storage
from tests.support.clients.actions import change
from tests.support.databases import on_both_databases
from tests.support.leagues.served_leagues import promote
from tests.support.waiting import until


def test_a_league(read_only_client: TestClient) -> None:
    league = read_only_client.get("/v1/leagues/duo").json()
    assert (league["league"], league["champion"], league["faults"]) == ("duo", 1, [])
    assert league["agents"] == {"agent_left": "left", "agent_right": "right"}
    assert league["policies"]["left"]["action"]["n"] == 7
    assert league["baselines"] == ["script:random", "script:one_ply"]
    (row,) = read_only_client.get("/v1/leagues/empty").json()["replicas"]
    assert (row["replica"], row["version"], row["aliases"], row["event"]) == ("replica-1", None, {}, None)
    assert row["silent_seconds"] < 60


def test_versions(read_only_client: TestClient, storage: Storage) -> None:
    path = "/v1/leagues/board/versions"
    registry = Registry.open(storage)
    versions = read_only_client.get(path).json()["versions"]
    assert [version["version"] for version in versions] == [1, 2, 3]
    assert [version["aliases"] for version in versions] == [["champion"], [], []]
    assert versions[1]["sha256"] == registry.versions.get("board", 2).sha256
    assert versions[0]["policies"] == ["shared"]
    assert [read_only_client.get(f"{path}/{ref}").json() for ref in (2, "champion")] == [versions[1], versions[0]]
    assert read_only_client.get("/v1/leagues/empty/versions").json()["versions"] == []
    registry.close()


def test_unknown_leagues_and_versions_are_reported(read_only_client: TestClient) -> None:
    for path, status, code in (
        ("board/versions/9", 404, "unknown_version"),
        ("board/versions/nobody", 404, "unknown_alias"),
        ("board/versions/NO", 400, "invalid_reference"),
        ("nobody", 404, "unknown_league"),
        ("nobody/versions", 404, "unknown_league"),
        ("nobody/versions/1", 404, "unknown_league"),
        ("NO", 400, "invalid_reference"),
    ):
        reply = read_only_client.get(f"/v1/leagues/{path}")
        assert (reply.status_code, reply.json()["code"]) == (status, code), path
        assert code != "unknown_league" or "board" in reply.json()["message"], "the known leagues are listed"
    assert read_only_client.post("/v1/leagues").json()["code"] == "method_not_allowed"


def test_health(read_only_client: TestClient) -> None:
    assert read_only_client.get("/v1/health/live").json() == {"status": "live", "replica": "replica-1"}
    assert read_only_client.get("/v1/health/ready").json() == {"status": "ready", "replica": "replica-1"}


NOTE = "/v1/leagues/board/versions/2/note"


def bearer(token: str) -> dict[str, str]:
    return {"authorization": f"Bearer {token}"}


def test_a_note_is_in_the_versions_with_the_name_of_the_key(promoter: TestClient) -> None:
    reply = promoter.put(NOTE, json={"note": "<b>bold</b>"})
    assert reply.status_code == 200
    written = reply.json()["note"]
    assert (reply.json()["version"], written["text"], written["actor"]) == (2, "<b>bold</b>", "release-bot")
    versions = promoter.get("/v1/leagues/board/versions").json()["versions"]
    assert [version["note"] for version in versions] == [None, written, None]
    assert promoter.put(NOTE, json={"note": ""}).json()["note"] is None
    assert promoter.put("/v1/leagues/board/versions/champion/note", json={"note": "leads"}).json()["version"] == 1


def test_an_invalid_note_is_rejected(promoter: TestClient, registry: Registry, subtests: pytest.Subtests) -> None:
    for path, body, status, message in (
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
    ):
        with subtests.test(path=path, body=body):
            reply = promoter.put(path, json=body)
            assert (reply.status_code, message in reply.json()["message"]) == (status, True), reply.text
    _, reader = registry.keys.create("reader", ["read", "act", "evaluate"])
    until(lambda: promoter.get("/v1/key", headers=bearer(reader)).status_code == 200)
    reply = promoter.put(NOTE, json={"note": "x"}, headers=bearer(reader))
    assert (reply.status_code, reply.json()["code"]) == (403, "forbidden")
    assert [row.note for row in registry.versions.all("board")] == [None, None, None]


CHAMPION = "/v1/leagues/board/aliases/champion"
ROLLBACK = "/v1/leagues/board/rollback"


@on_both_databases
def test_a_promotion_is_in_the_history_with_the_name_of_the_key(promoter: TestClient, registry: Registry) -> None:
    event = change(promoter, CHAMPION, "a", {"version": 2, "expected": 1, "reason": "it is stronger"})
    assert event.pop("at")
    assert event.pop("event")
    expected = {"league": "board", "alias": "champion", "kind": "set", "version": 2, "previous": 1, "verdict": None}
    assert event == expected | {"actor": "release-bot", "reason": "it is stronger"}
    newest = registry.aliases.history("board")[0]
    assert (newest.version, newest.actor, newest.reason) == (2, "release-bot", "it is stronger")
    candidate = change(promoter, "/v1/leagues/board/aliases/candidate", "c", {"version": 3, "expected": None})
    assert candidate["previous"] is None
    assert registry.aliases.current("board") == {"champion": 2, "candidate": 3}


@on_both_databases
def test_a_rollback_of_another_version_changes_nothing(promoter: TestClient, registry: Registry) -> None:
    """Two people who roll back the same version do not go back twice."""
    for version in (2, 3):
        promote(registry, "board", version)
    event = change(promoter, ROLLBACK, "a", {"expected": 3})
    assert (event["kind"], event["version"], event["previous"]) == ("rollback", 2, 3)
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
def test_a_mixture_is_published_once_and_promoted(promoter: TestClient, registry: Registry) -> None:
    members = [{"version": 3, "probability": 0.4}, {"version": 1, "probability": 0.6}]
    event = change(promoter, CHAMPION, "a", {"members": members, "expected": 1})
    assert (event["version"], event["previous"]) == (4, 1)
    assert change(promoter, CHAMPION, "a", {"members": members, "expected": 1}) == event
    assert change(promoter, "/v1/leagues/board/aliases/candidate", "b", {"members": members})["version"] == 4
    assert change(promoter, ROLLBACK, "c", {"expected": 4})["version"] == 1


INVALID: tuple[tuple[str, Any, int, str], ...] = (
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
    (CHAMPION, {"members": [{"version": 2, "probability": 0.5}] * 2}, 400, "named twice"),
    (CHAMPION, {"members": [{"version": n, "probability": 0.3} for n in (1, 2)]}, 400, "sum to 0.6"),
    (CHAMPION, {"members": [{"version": n, "probability": 0.5} for n in (1, 99)]}, 404, "99"),
    (CHAMPION, {"members": [{"version": 2}]}, 400, "probability"),
    (CHAMPION, {"version": 2, "expected": 3}, 409, "champion"),
    (CHAMPION, {"version": 2, "expected": None}, 409, "champion"),
    (ROLLBACK, {"version": 1}, 400, "version"),
    (ROLLBACK, {}, 409, "champion"),
    ("/v1/leagues/chess/rollback", {}, 404, "chess"),
    ("/v1/leagues/board/aliases/12", {"version": 2}, 400, "12"),
    ("/v1/leagues/board/aliases/A%00", {"version": 2}, 400, "alias"),
)


@on_both_databases
def test_invalid_changes_are_rejected(promoter: TestClient, registry: Registry, subtests: pytest.Subtests) -> None:
    history = registry.aliases.history("board")
    for path, body, status, message in INVALID:
        with subtests.test(path=path, body=body):
            assert message in change(promoter, path, "a", body, status)["message"]
    for key in (None, "", "x" * 256, "a\tb", "é"):
        with subtests.test(key=key):
            headers: Any = [] if key is None else [(b"idempotency-key", key.encode())]
            reply = promoter.post(CHAMPION, json={"version": 2}, headers=headers)
            assert (reply.status_code, reply.json()["code"]) == (400, "invalid_input")
            assert "Idempotency-Key" in reply.json()["message"]
    assert registry.aliases.history("board") == history


def test_changes_always_require_a_key(read_only_client: TestClient) -> None:
    assert read_only_client.get("/v1/leagues").status_code == 200, "other routes need no key"
    error = change(read_only_client, ROLLBACK, "a", status=401)
    assert (error["code"], "league keys create NAME --scope promote" in error["message"]) == ("unauthenticated", True)


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
def test_waiting_changes_do_not_delay_reading(promoter: TestClient, registry: Registry) -> None:
    def call(number: int) -> int:
        headers = {"idempotency-key": str(number), "x-request-timeout-ms": "1500"}
        return promoter.post(CHAMPION, json={"version": 2}, headers=headers).status_code

    with ThreadPoolExecutor(8) as pool:
        with locked(registry):
            waiting = [pool.submit(call, number) for number in range(8)]
            assert promoter.get("/v1/leagues/board").status_code == 200
            assert not all(future.done() for future in waiting)
        assert {future.result() for future in waiting} <= {200, 503, 504}
