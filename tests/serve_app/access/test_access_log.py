"""The access log contains each request, and no tokens."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient

from league.registry.registry import Registry
from tests.support.clients.actions import BOARD, act
from tests.support.servers.replicas import QUICK, replica
from tests.support.waiting import until

LOGGING_SETTINGS = QUICK.model_copy(update={"access_log": "logs"})


@pytest.fixture
def log(registry: Registry) -> Path:
    return registry.storage.home / "logs" / "access-replica-1.jsonl"


def lines(log: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in log.read_text().splitlines()]


@pytest.fixture
def logging_client(registry: Registry) -> Iterator[TestClient]:
    with replica(registry.storage, LOGGING_SETTINGS) as client:
        yield client


def test_each_request_is_a_line(registry: Registry, log: Path) -> None:
    _, token = registry.keys.create("game-server", ["act"])
    with replica(registry.storage, LOGGING_SETTINGS) as client:
        client.headers["authorization"] = f"Bearer {token}"
        act(client, version=2, observation=BOARD)
        client.post("/v1/policies/board/action", json={})
        client.get("/v1/leagues")
        client.post("/v1/policies/board/action", headers={"authorization": "Bearer nothing"})
        client.get("/v1/health/live")
    found = lines(log)
    action = "/v1/policies/board/action"
    assert [[line[name] for name in ("method", "route", "policy", "version", "status", "key")] for line in found] == [
        ["POST", action, "board", 2, 200, "game-server"],
        ["POST", action, None, None, 400, "game-server"],
        ["GET", "/v1/leagues", None, None, 403, None],
        ["POST", action, None, None, 401, None],
        ["GET", "/v1/health/live", None, None, 200, None],
    ]
    assert all(line["us"] > 0 and line["time"].endswith("Z") for line in found)
    assert token not in log.read_text()


def test_inferences_are_logged_with_their_version(logging_client: TestClient, log: Path) -> None:
    body = {
        "inputs": [
            {"name": "observation", "shape": [1, 6, 7, 2], "datatype": "INT8", "data": [0] * 84},
            {"name": "action_mask", "shape": [1, 7], "datatype": "INT8", "data": [1] * 7},
        ]
    }
    assert logging_client.post("/v2/models/board/versions/3/infer", json=body).status_code == 200
    until(log.exists)
    until(lambda: [(line["policy"], line["version"]) for line in lines(log)] == [("board", 3)])


def test_requests_succeed_if_the_log_cannot_be_written(registry: Registry, log: Path) -> None:
    log.parent.write_text("a file where the directory should be")
    with replica(registry.storage, LOGGING_SETTINGS) as client:
        for _ in range(3):
            act(client, observation=BOARD)


def test_by_default_nothing_is_logged(client: TestClient, log: Path) -> None:
    act(client, observation=BOARD)
    assert not log.exists()
