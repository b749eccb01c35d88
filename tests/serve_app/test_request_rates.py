"""Requests a second, from what replicas report: of all replicas together, and of a league alone."""

import pytest
from starlette.testclient import TestClient

from serve_app import request_rates
from serve_app.metrics import Report
from serve_app.request_rates import RATE, SECONDS, RequestRates, Requests, requests
from tests.evaluation.waiting import until
from tests.serve_app.test_action import BOARD, act


def report(**counts: list[int]) -> Report:
    """league → requests of each of its versions."""
    return {
        SECONDS: [
            [[league, "shared", str(version), "action"], {"counts": [0, count], "sum": 0.1}]
            for league, each in counts.items()
            for version, count in enumerate(each, 1)
        ]
    }


def test_a_rate_is_of_what_came_since_the_last_report(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 100.0
    monkeypatch.setattr(request_rates, "monotonic", lambda: now)
    rates = RequestRates()
    now = 104.0
    assert rates.since_last(report(board=[8, 4], duo=[0])) == [[["board"], 3.0], [["duo"], 0.0]]
    now = 106.0
    assert rates.since_last(report(board=[9, 5], duo=[10])) == [[["board"], 1.0], [["duo"], 5.0]]
    assert rates.since_last(report(board=[2])) == [[["board"], 0.0]], "a policy was forgotten, and no time has passed"


def test_those_of_all_replicas_add_up() -> None:
    reports = [
        report(board=[8, 4]) | {RATE: [[["board"], 3.0]]},
        report(board=[1], duo=[2]) | {RATE: [[["board"], 0.5]]},
    ]
    assert requests(reports) == {"board": Requests(13, 3.5), "duo": Requests(2, 0.0)}
    assert requests([{}]) == {}


def test_a_replica_says_them_of_each_league(client: TestClient) -> None:
    for _ in range(5):
        act(client, observation=BOARD)

    def board() -> dict[str, float]:
        leagues = client.get("/v1/leagues").json()["leagues"]
        return next(each for each in leagues if each["league"] == "board")

    seen = []
    until(lambda: seen.append(board()) or seen[-1]["requests"] == 5)  # type: ignore[func-returns-value]
    assert max(each["requests_per_second"] for each in seen) > 0
    until(lambda: board()["requests_per_second"] == 0)
    assert client.get("/v1/leagues/board").json()["requests"] == 5
