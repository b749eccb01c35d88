"""Prometheus metrics, and what they report: requests, their rates, the load of a replica, and disk space."""

import os
import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
import pytest
from prometheus_client.parser import text_string_to_metric_families
from starlette.testclient import TestClient

from league.registry.registry import Registry
from league.registry.storage.rows import Portion
from league.settings import Storage
from serve_app.app import Replica
from serve_app.observability import load, metrics_reporter
from serve_app.observability.load import SATURATED, LoadSample, LoadSampler
from serve_app.observability.metrics import BATCH_SIZES, MAX_SERIES, Report, RequestStats
from serve_app.observability.metrics_reporter import (
    RATE,
    SECONDS,
    DiskSpace,
    RequestCounts,
    RequestRates,
    request_counts,
)
from serve_app.observability.prometheus import METRICS, render
from tests.support.clients.actions import BOARD, act, boards, version_for
from tests.support.leagues.served_leagues import promote
from tests.support.servers.exposition import samples, value
from tests.support.servers.replicas import QUICK, local_client, replica
from tests.support.waiting import until


def test_requests_are_counted_by_policy_and_version(client: TestClient) -> None:
    for _ in range(3):
        act(client, observation=BOARD)
    act(client, "board.shared", version=2, observations=boards(5))
    until(lambda: value(client, "league_request_seconds_count") == 4)
    assert value(client, "league_request_seconds_count", policy="shared", version="1", api="action") == 3
    assert value(client, "league_request_seconds_bucket", version="1", le="+Inf") == 3
    assert value(client, "league_request_seconds_bucket", version="1", le="5.0") == 3
    assert 0 < value(client, "league_request_seconds_sum", version="1") < 3
    assert value(client, "league_batch_observations_sum", league="board", version="2") == 5
    assert value(client, "league_batch_observations_bucket", version="2", le="4") == 0
    assert value(client, "league_batch_observations_bucket", version="2", le="8") == 1
    assert value(client, "league_requests_in_flight", api="action") == 0
    assert value(client, "league_replica_resident_bytes") > 10 * 2**20
    until(lambda: value(client, "league_replica_load") > 0)


def test_errors_are_counted_by_code(client: TestClient) -> None:
    for path, body in (
        ("/v1/policies/board/action", {}),
        ("/v1/policies/board/action", {}),
        ("/v1/policies/board/action?version=9", {"observation": BOARD}),
        ("/v2/models/board/infer", {}),
        ("/v1/policies/nobody/action", {"observation": BOARD}),
        ("/nowhere", {}),
    ):
        assert client.post(path, json=body).status_code >= 400
    until(lambda: value(client, "league_errors_total") == 6)
    assert value(client, "league_errors_total", league="board", code="invalid_input") == 3
    assert value(client, "league_errors_total", league="board", code="unknown_version") == 1
    assert value(client, "league_errors_total", league="", code="unknown_league") == 1
    assert value(client, "league_errors_total", league="", code="unknown_path") == 1


def test_swaps_and_live_versions_are_reported(client: TestClient, registry: Registry) -> None:
    until(lambda: value(client, "league_live_version", league="board", alias="champion") == 1)
    promote(registry, "board", 3)
    until(lambda: value(client, "league_live_version", league="board", alias="champion") == 3)
    assert value(client, "league_swaps_total", league="board") == 2
    assert value(client, "league_swaps_total", league="duo") == 1
    assert value(client, "league_faults", league="board") == 0
    (registry.artifacts.path("board", 2) / "shared.onnx").unlink()
    promote(registry, "board", 2)
    until(lambda: value(client, "league_faults", league="board") == 1)


def test_canary_and_shadow_are_counted(client: TestClient, registry: Registry) -> None:
    registry.traffic.set("board", canary=Portion(2, 1.0), shadow=Portion(3, 1.0), actor="test", reason="test")
    until(lambda: value(client, "league_shadow_share", league="board") == 1)
    assert [version_for(client, "a"), version_for(client)] == [2, 1]
    until(lambda: value(client, "league_shadow_requests_total", candidate="3", champion="1") == 1)
    for name in ("league_canary_requests_total", "league_canary_share"):
        assert value(client, name, league="board") == 1
    assert value(client, "league_shadow_inference_seconds_count", candidate="3") == 1
    traffic = client.get("/v1/leagues/board/traffic").json()
    for statistics in (traffic["all"], traffic["here"]):
        assert [(one["version"], one["as_canary"]) for one in statistics["versions"]] == [(1, 0), (2, 1)]
        assert [one["requests"] for one in statistics["shadows"]] == [1]


def test_each_replica_reports_for_all(registry: Registry) -> None:
    servers = [Replica(Registry.open(registry.storage), QUICK, f"replica-{number}") for number in (1, 2)]
    with local_client(servers[0]) as first, local_client(servers[1]) as second:
        act(first, observation=BOARD)
        for _ in range(2):
            act(second, observation=BOARD)
        for client in (first, second):
            until(lambda client=client: value(client, "league_request_seconds_count") == 3)
            assert value(client, "league_request_seconds_count", replica="replica-1") == 1
        assert first.get("/v1/leagues/board/traffic").json()["all"]["versions"][0]["requests"] == 3
    with replica(registry.storage) as third:
        replicas = {sample.labels["replica"] for sample in samples(third)}
        assert replicas <= {"", "replica-1"}, "stopped replicas are removed"


def test_metrics_require_a_key_with_read_scope_if_keys_are_required(registry: Registry) -> None:
    tokens = {scope: registry.keys.create(scope, [scope])[1] for scope in ("read", "act")}
    with replica(registry.storage) as client:
        assert client.get("/metrics").status_code == 401
        assert client.get("/metrics", headers={"x-api-key": tokens["act"]}).status_code == 403
        client.headers["x-api-key"] = tokens["read"]
        for code in ("forbidden", "unauthenticated"):
            until(lambda code=code: value(client, "league_key_rejections_total", code=code) >= 1)


def test_batch_sizes_are_counted_in_their_buckets() -> None:
    for rows in range(1, 1100):
        served = RequestStats()
        served.add(rows, 1)
        assert served.sizes.index(1) == int(np.searchsorted(BATCH_SIZES, rows))


@pytest.mark.anyio
async def test_the_number_of_series_is_limited(registry: Registry) -> None:
    server = Replica(registry, QUICK, "replica-1")
    server.alias_slots.update({("board", "champion"): 1})
    await server.alias_slots.settle(30)
    version = server.alias_slots.champion("board")
    assert version is not None
    for api in range(MAX_SERIES + 5):
        server.metrics.count_request(str(api), version.policy(None), 1, 1)
    assert len(server.metrics.report()["league_request_seconds"]) == MAX_SERIES


ADDED_LATER = {
    *("league_disk_free_bytes", "league_disk_size_bytes"),
    *("league_evaluations", "league_silent_replicas", "league_replica_load", "league_requests_in_flight"),
}
"""Metrics that the reporter or the route adds."""


@pytest.mark.anyio
async def test_all_reported_metrics_are_documented(registry: Registry) -> None:
    server = Replica(registry, QUICK, "replica-1")
    assert server.metrics.report().keys() | ADDED_LATER == METRICS.keys()


def test_labels_are_escaped() -> None:
    report = {"league_errors_total": [[['a"b\\c\nd', "code"], 1]]}
    families = text_string_to_metric_families(render({"replica": report}).decode())
    assert [sample.labels["league"] for family in families for sample in family.samples] == ['a"b\\c\nd']


def report(**counts: list[int]) -> Report:
    """league → requests of each of its versions."""
    return {
        SECONDS: [
            [[league, "shared", str(version), "action"], {"counts": [0, count], "sum": 0.1}]
            for league, requests in counts.items()
            for version, count in enumerate(requests, 1)
        ]
    }


def test_a_rate_covers_the_time_since_the_last_report(monkeypatch: pytest.MonkeyPatch) -> None:
    time = 100.0
    monkeypatch.setattr(metrics_reporter, "monotonic", lambda: time)
    rates = RequestRates()
    time = 104.0
    assert rates.since_last(report(board=[8, 4], duo=[0])) == [[["board"], 3.0], [["duo"], 0.0]]
    time = 106.0
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
        return next(league for league in leagues if league["league"] == "board")

    replies: list[Any] = []
    until(lambda: replies.append(act(client, observation=BOARD)) or board()["requests_per_second"] > 0)
    until(lambda: board()["requests"] == len(replies))
    until(lambda: board()["requests_per_second"] == 0)
    assert client.get("/v1/leagues/board").json()["requests"] == len(replies)


def test_the_load_is_that_of_the_scarcest_resource() -> None:
    for resource, cpu, runnable, in_progress, expected in (
        ("processor", 0.3, 0.3, 0.1, 0.3),
        ("delayed by others", 0.3, 0.8, 0.0, 0.3),
        ("saturated", 0.3, 0.95, 0.0, 0.95),
        ("threads", 1.7, 0.95, 0.0, 1.7),
        ("delayed in threads", 0.3, 0.3, 4.0, 0.3),
        ("waiting in threads", 0.3, 0.3, 19.0, 0.95),
    ):
        assert LoadSample(cpu, runnable, in_progress).load == pytest.approx(expected), resource


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
    assert (first.requests, first.in_progress > 0, first.cpu > 0) == ({"action": 2}, True, True)
    assert (second.requests, second.in_progress) == ({"action": 0}, 0)


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
    with ThreadPoolExecutor(1) as thread:
        assert 0 <= thread.submit(load._runnable_seconds).result() < 1


def test_both_disks_are_measured(tmp_path: Path) -> None:
    disks = DiskSpace(Storage.at(tmp_path))
    (tmp_path / "artifacts").mkdir()
    disks.report()
    until(lambda: len(disks._sizes) == 2)
    report = disks.report()
    expected = shutil.disk_usage(tmp_path)
    assert {disk for (disk,), _ in report["league_disk_free_bytes"]} == {"home", "artifacts"}
    for (_,), size in report["league_disk_size_bytes"]:
        assert size == pytest.approx(expected.used + expected.free, rel=0.01)


def test_a_disk_that_does_not_respond_has_no_samples(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    answers, asked = Event(), []

    def statvfs(path: Path) -> os.statvfs_result:
        if path.is_relative_to(tmp_path):  # a server of other tests measures its disks as well
            asked.append(path)
        answers.wait(60)
        raise OSError

    monkeypatch.setattr(os, "statvfs", statvfs)
    disks = DiskSpace(Storage.at(tmp_path))
    try:
        for _ in range(3):
            assert disks.report() == {"league_disk_free_bytes": [], "league_disk_size_bytes": []}
        assert len(asked) == 2, "one measurement per disk is waiting"
    finally:
        answers.set()
