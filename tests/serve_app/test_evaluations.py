"""Evaluations over HTTP, without playing games: submitted, rejected, listed and stopped."""

from collections.abc import Iterator
from threading import Event
from typing import Any

import pytest
from starlette.testclient import TestClient

from league.registry.registry import Registry
from serve_app.app import Replica
from tests.support.databases import on_both_databases
from tests.support.leagues.served_leagues import promote
from tests.support.servers.replicas import QUICK, UnavailableEvaluation, local_client, replica
from tests.support.waiting import until

BOARD = "/v1/leagues/board/evaluations"


@pytest.fixture
def evaluator(client: TestClient, registry: Registry) -> TestClient:
    """The client with a key that may start evaluations, but not nightly runs."""
    return with_key(client, registry, "bot", ["evaluate", "read"])


@pytest.fixture(scope="module")
def shared_evaluator(shared_registry: Registry) -> Iterator[TestClient]:
    with replica(shared_registry.storage) as client:
        yield with_key(client, shared_registry, "bot", ["evaluate", "read"])


def with_key(client: TestClient, registry: Registry, name: str, scopes: list[str]) -> TestClient:
    _, token = registry.keys.create(name, scopes)
    client.headers["x-api-key"] = token
    until(lambda: client.get("/v1/leagues").status_code != 401)
    until(lambda: client.post(BOARD, content=b"x").status_code != 401)
    return client


def start(
    client: TestClient, body: Any = None, call: str = "a", path: str = BOARD, status: int = 202
) -> dict[str, Any]:
    content = {"content": body} if isinstance(body, bytes) else {"json": body or {}}
    reply = client.post(path, headers={"idempotency-key": call}, **content)
    assert reply.status_code == status, reply.text
    return dict(reply.json())


class NotifiedEvaluation(UnavailableEvaluation):
    """An evaluation service that is only notified."""

    def __init__(self) -> None:
        self.is_notified = Event()

    def notify(self) -> None:
        """Remember it."""
        self.is_notified.set()


def test_replicas_start_the_service_for_an_interrupted_evaluation(registry: Registry) -> None:
    registry.evaluations.submit("board", {"kind": "tournament"}, actor="bot", reason="test", max_active=1)
    registry.evaluations.claim("a process that has ended", workers=1)
    service = NotifiedEvaluation()
    with local_client(Replica(Registry.open(registry.storage), QUICK, "replica-1", evaluation_client=service)):
        until(service.is_notified.is_set)


@on_both_databases
def test_a_submitted_evaluation_is_queued_with_pinned_references(evaluator: TestClient, registry: Registry) -> None:
    contestants = ["board@champion", "board@3", "script:random"]
    reply = evaluator.post(
        BOARD,
        json={"contestants": contestants, "blocks": 4, "reason": "try"},
        headers={"idempotency-key": "a"},
    )
    document = reply.json()
    promote(registry, "board", 2)
    assert (reply.status_code, reply.headers["location"]) == (202, f"{BOARD}/{document['evaluation']}")
    assert document["request"] == {
        "kind": "tournament",
        "schedule": "round_robin",
        "contestants": ["board@1", "board@3", "script:random"],
        "against": [],
        "games": None,
        "minutes": None,
        "precision": None,
        "blocks": 4,
        "seed": 0,
    }
    assert (document["state"], document["actor"], document["reason"]) == ("queued", "bot", "try")
    assert evaluator.get(reply.headers["location"]).json() == document


def test_by_default_all_versions_play(evaluator: TestClient) -> None:
    assert start(evaluator, b"")["request"]["contestants"] == ["board@1", "board@2", "board@3"]


@pytest.mark.parametrize(
    ("path", "body", "status", "code"),
    [
        ("/v1/leagues/chess/evaluations", {}, 404, "unknown_league"),
        (BOARD, {"contestants": ["board@9"]}, 404, "unknown_version"),
        (BOARD, {"contestants": ["board@candidate"]}, 404, "unknown_alias"),
        (BOARD, {"contestants": ["script:os:system"]}, 404, "unknown_policy"),
        (BOARD, {"contestants": ["script:clever"]}, 404, "unknown_policy"),
        (BOARD, {"contestants": ["memory@1"]}, 400, "environment_mismatch"),
        ("/v1/leagues/vector/evaluations", {"contestants": ["script:one_ply"]}, 400, "environment_mismatch"),
        (BOARD, {"contestants": ["board"]}, 400, "invalid_reference"),
        (BOARD, {"contestants": "board@1"}, 400, "invalid_input"),
        (BOARD, {"contestants": ["board@1"] * 300}, 400, "invalid_input"),
        (BOARD, {"blocks": 0}, 400, "invalid_input"),
        (BOARD, {"blocks": "4"}, 400, "invalid_input"),
        (BOARD, {"seed": 2**63}, 400, "invalid_input"),
        (BOARD, {"games": 2**70}, 400, "invalid_input"),
        (BOARD, {"minutes": 1e300}, 400, "invalid_input"),
        (BOARD, {"game": 100}, 400, "invalid_input"),
        (BOARD, {"games": 1}, 400, "invalid_input"),
        (BOARD, {"against": ["script:random"]}, 400, "invalid_input"),
        (BOARD, {"schedule": "cross_play", "precision": 20}, 400, "invalid_input"),
        (BOARD, {"schedule": "gauntlet", "against": ["script:nobody"]}, 404, "unknown_policy"),
        (BOARD, {"schedule": "lottery"}, 400, "invalid_input"),
        (BOARD, {"kind": "yearly"}, 400, "invalid_input"),
        (BOARD, {"kind": "nightly", "blocks": 4}, 400, "invalid_input"),
        (BOARD, {"kind": "nightly"}, 403, "forbidden"),
        (BOARD, b"[1]", 400, "invalid_input"),
        (BOARD, b"nonsense", 400, "invalid_input"),
    ],
)
def test_invalid_evaluations_are_rejected_at_once(
    shared_evaluator: TestClient, shared_registry: Registry, path: str, body: Any, status: int, code: str
) -> None:
    error = start(shared_evaluator, body, path=path, status=status)
    assert error["code"] == code
    assert shared_registry.evaluations.newest("board") == []


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ({"kind": "yearly"}, "kind must be 'tournament' or 'nightly'"),
        ({"blocks": 0}, "blocks: Input should be greater than or equal to 1"),
        ({"contestants": ["memory@1"]}, "memory@1 is not a version of league board"),
    ],
)
def test_the_message_names_the_invalid_value(shared_evaluator: TestClient, body: Any, message: str) -> None:
    assert message in start(shared_evaluator, body, status=400)["message"]


def test_a_nightly_run_requires_a_key_that_may_promote(client: TestClient, registry: Registry) -> None:
    promoter = with_key(client, registry, "owl", ["evaluate", "promote"])
    assert start(promoter, {"kind": "nightly"})["request"] == {"kind": "nightly"}


@pytest.mark.parametrize(("scopes", "status"), [(["read", "act", "promote"], 403), (["read"], 403)])
def test_other_keys_cannot_start_or_stop_evaluations(
    client: TestClient, registry: Registry, scopes: list[str], status: int
) -> None:
    other = with_key(client, registry, "other", scopes)
    start(other, status=status)
    assert other.delete(f"{BOARD}/1").status_code == status


def test_evaluations_always_require_a_key(client: TestClient) -> None:
    assert client.get(BOARD).json() == {"league": "board", "evaluations": [], "next": None}
    assert start(client, status=401)["code"] == "unauthenticated"
    assert client.delete(f"{BOARD}/1").status_code == 401


@on_both_databases
def test_a_repeated_call_starts_nothing(evaluator: TestClient, registry: Registry) -> None:
    first = start(evaluator, {"blocks": 4})
    assert start(evaluator, b' {"blocks" : 4} ') == first
    assert start(evaluator, {"blocks": 5}, status=409)["code"] == "idempotency_key_reused"
    assert evaluator.post(BOARD, json={}).status_code == 400, "an idempotency key is required"
    assert len(registry.evaluations.newest("board")) == 1


@on_both_databases
def test_evaluations_are_paginated_newest_first(evaluator: TestClient) -> None:
    numbers = [start(evaluator, call=str(i))["evaluation"] for i in range(5)]
    page = evaluator.get(BOARD, params={"limit": 2}).json()
    assert [each["evaluation"] for each in page["evaluations"]] == numbers[:2:-1]
    assert "result" not in page["evaluations"][0]
    rest = evaluator.get(BOARD, params={"before": page["next"], "limit": 3}).json()
    assert ([each["evaluation"] for each in rest["evaluations"]], rest["next"]) == (numbers[2::-1], None)


@pytest.mark.parametrize("query", ["limit=0", "limit=101", "limit=x", "before=-1", "before=99999999999"])
def test_an_invalid_page_is_rejected(shared_evaluator: TestClient, query: str) -> None:
    assert shared_evaluator.get(f"{BOARD}?{query}").json()["code"] == "invalid_input"


@on_both_databases
def test_a_queued_evaluation_is_stopped_at_once_and_once(evaluator: TestClient) -> None:
    number = start(evaluator)["evaluation"]
    stopped = evaluator.delete(f"{BOARD}/{number}")
    assert (stopped.status_code, stopped.json()["state"], stopped.json()["stopped_by"]) == (200, "stopped", "bot")
    assert evaluator.delete(f"{BOARD}/{number}").json() == stopped.json()


def test_an_unknown_evaluation_is_reported(evaluator: TestClient) -> None:
    start(evaluator)
    for number in ("7", "0", "x", "9" * 20, "-1"):
        for reply in (evaluator.get(f"{BOARD}/{number}"), evaluator.delete(f"{BOARD}/{number}")):
            assert (reply.status_code, reply.json()["code"]) == (404, "unknown_evaluation"), number


@on_both_databases
def test_an_evaluation_of_another_league_is_unknown(evaluator: TestClient) -> None:
    number = start(evaluator)["evaluation"]
    reply = evaluator.get(f"/v1/leagues/memory/evaluations/{number}")
    assert reply.json()["code"] == "unknown_evaluation"


@on_both_databases
def test_the_number_of_active_evaluations_is_limited(registry: Registry) -> None:
    with replica(registry.storage, QUICK.model_copy(update={"max_evaluations": 2})) as client:
        evaluator = with_key(client, registry, "bot", ["evaluate", "read"])
        first = start(evaluator, call="a")["evaluation"]
        start(evaluator, call="b")
        assert start(evaluator, call="c", status=429)["code"] == "too_many_evaluations"
        evaluator.delete(f"{BOARD}/{first}")
        start(evaluator, call="c")


def test_a_missing_evaluation_service_is_reported(registry: Registry) -> None:
    server = Replica(Registry.open(registry.storage), QUICK, "replica-1")
    with local_client(server) as client:
        evaluator = with_key(client, registry, "bot", ["evaluate", "read"])
        error = start(evaluator, status=503)
        assert error["code"] == "no_evaluation_service"
        assert evaluator.get(BOARD).json()["evaluations"] == []


@on_both_databases
def test_the_number_of_queued_evaluations_is_a_metric(evaluator: TestClient) -> None:
    start(evaluator)
    assert 'league_evaluations{league="board",replica="",state="queued"} 1.0' in evaluator.get("/metrics").text
