"""The load of a replica, from processor time, queueing, and requests in progress."""

import threading
from pathlib import Path

import pytest
from starlette.testclient import TestClient

from league.registry.registry import Registry
from serve_app.app import Replica
from serve_app.observability import load
from serve_app.observability.load import SATURATED, LoadSample, LoadSampler
from tests.support.clients.actions import BOARD, act, boards
from tests.support.servers.exposition import value
from tests.support.servers.replicas import QUICK, local_client
from tests.support.waiting import until


@pytest.mark.parametrize(
    ("cpu", "runnable", "in_progress", "expected"),
    [
        (0.3, 0.3, 0.1, 0.3),
        (0.3, 0.8, 0.0, 0.3),
        (0.3, 0.95, 0.0, 0.95),
        (1.7, 0.95, 0.0, 1.7),
        (0.3, 0.3, 4.0, 0.3),
        (0.3, 0.3, 19.0, 0.95),
    ],
    ids=["processor", "delayed by others", "saturated", "threads", "delayed in threads", "waiting in threads"],
)
def test_the_load_is_that_of_the_scarcest_resource(
    cpu: float, runnable: float, in_progress: float, expected: float
) -> None:
    assert LoadSample(cpu, runnable, in_progress).load == pytest.approx(expected)


def test_requests_are_counted_between_samples(registry: Registry) -> None:
    server = Replica(registry, QUICK, "replica-1")
    with local_client(server) as client:
        sampler = LoadSampler(server.metrics)
        assert sampler.sample() is None, "the first call begins an interval"
        act(client, observation=BOARD)
        act(client, observations=boards(3))
        first = sampler.sample()
        second = sampler.sample()
    assert first is not None
    assert second is not None
    assert first.requests == {"action": 2}
    assert first.in_progress > 0
    assert first.cpu > 0
    assert second.requests == {"action": 0}
    assert second.in_progress == 0


def test_a_busy_thread_is_runnable(registry: Registry) -> None:
    sampler = LoadSampler(Replica(registry, QUICK, "replica-1").metrics)
    sampler.sample()
    before = load._runnable_seconds()
    while load._runnable_seconds() < before + 0.2:
        pass
    sample = sampler.sample()
    assert sample is not None
    assert sample.runnable > 0.5
    assert SATURATED < 1


def test_without_statistics_of_the_scheduler_the_time_of_the_thread_counts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(load, "SCHEDULER_STATISTICS", tmp_path / "missing")
    found: list[float] = []
    thread = threading.Thread(target=lambda: found.append(load._runnable_seconds()))
    thread.start()
    thread.join()
    assert 0 <= found[0] < 1


def test_a_replica_reports_its_load(client: TestClient) -> None:
    until(lambda: value(client, "league_replica_load") > 0)
