"""Request rates from the reports of replicas: of all replicas together, and of each league."""

import pytest
from starlette.testclient import TestClient

from serve_app.observability import metrics_reporter
from serve_app.observability.metrics import Report
from serve_app.observability.metrics_reporter import RATE, SECONDS, RequestCounts, RequestRates, request_counts
from tests.support.clients.actions import BOARD, act
from tests.support.waiting import until


def report(**counts: list[int]) -> Report:
    """league → requests of each of its versions."""
    return {
        SECONDS: [
            [[league, "shared", str(version), "action"], {"counts": [0, count], "sum": 0.1}]
            for league, each in counts.items()
            for version, count in enumerate(each, 1)
        ]
    }


def test_a_rate_covers_the_time_since_the_last_report(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 100.0
    monkeypatch.setattr(metrics_reporter, "monotonic", lambda: now)
    rates = RequestRates()
    now = 104.0
    assert rates.since_last(report(board=[8, 4], duo=[0])) == [[["board"], 3.0], [["duo"], 0.0]]
    now = 106.0
    assert rates.since_last(report(board=[9, 5], duo=[10])) == [[["board"], 1.0], [["duo"], 5.0]]
    assert rates.since_last(report(board=[2])) == [[["board"], 0.0]], "counts may decrease"


def test_counts_of_all_replicas_are_added() -> None:
    reports = [
        report(board=[8, 4]) | {RATE: [[["board"], 3.0]]},
        report(board=[1], duo=[2]) | {RATE: [[["board"], 0.5]]},
    ]
    assert request_counts(reports) == {"board": RequestCounts(13, 3.5), "duo": RequestCounts(2, 0.0)}
    assert request_counts([{}]) == {}


def test_a_replica_reports_the_rate_of_each_league(client: TestClient) -> None:
    def board() -> dict[str, float]:
        leagues = client.get("/v1/leagues").json()["leagues"]
        return next(each for each in leagues if each["league"] == "board")

    calls = 0

    def rate_after_a_call() -> float:
        nonlocal calls
        calls += 1
        act(client, observation=BOARD)
        return board()["requests_per_second"]

    until(lambda: rate_after_a_call() > 0)
    until(lambda: board()["requests"] == calls)
    until(lambda: board()["requests_per_second"] == 0)
    assert client.get("/v1/leagues/board").json()["requests"] == calls
