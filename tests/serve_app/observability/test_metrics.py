"""Prometheus metrics: each request is counted once, whichever replica is scraped."""

from collections.abc import Iterator

import numpy as np
import pytest
from prometheus_client.parser import text_string_to_metric_families
from starlette.testclient import TestClient

from league.registry.registry import Registry
from league.registry.storage.rows import Portion
from serve_app.app import Replica
from serve_app.observability.metrics import BATCH_SIZES, MAX_SERIES, RequestStats
from serve_app.observability.prometheus import METRICS, render
from tests.support.clients.actions import BOARD, act, boards
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
    client.post("/v1/policies/board/action", json={"observation": BOARD}, headers={"x-league-key": "a"})
    act(client, observation=BOARD)
    until(lambda: value(client, "league_shadow_requests_total", candidate="3", champion="1") == 1)
    assert value(client, "league_canary_requests_total", league="board", version="2") == 1
    assert value(client, "league_canary_share", league="board") == 1
    assert value(client, "league_shadow_inference_seconds_count", candidate="3") == 1
    traffic = client.get("/v1/leagues/board/traffic").json()
    for statistics in (traffic["all"], traffic["here"]):
        assert [(one["version"], one["as_canary"]) for one in statistics["versions"]] == [(1, 0), (2, 1)]
        assert [one["requests"] for one in statistics["shadows"]] == [1]


def test_each_replica_reports_for_all(registry: Registry) -> None:
    servers = [Replica(Registry.open(registry.storage), QUICK, f"replica-{number}") for number in (1, 2)]
    with (
        local_client(servers[0]) as first,
        local_client(servers[1]) as second,
    ):
        act(first, observation=BOARD)
        for _ in range(2):
            act(second, observation=BOARD)
        for client in (first, second):
            until(lambda client=client: value(client, "league_request_seconds_count") == 3)
            assert value(client, "league_request_seconds_count", replica="replica-1") == 1
        assert first.get("/v1/leagues/board/traffic").json()["all"]["versions"][0]["requests"] == 3
    with replica(registry.storage) as third:
        assert {sample.labels["replica"] for sample in samples(third)} <= {"", "replica-1"}, (
            "stopped replicas are removed"
        )


@pytest.fixture
def locked(registry: Registry) -> Iterator[TestClient]:
    with replica(registry.storage, QUICK.model_copy(update={"require_keys": "always"})) as client:
        yield client


def test_metrics_require_a_key_with_read_scope_if_keys_are_required(locked: TestClient, registry: Registry) -> None:
    tokens = {scope: registry.keys.create(scope, [scope])[1] for scope in ("read", "act")}
    assert locked.get("/metrics").status_code == 401

    def status(scope: str) -> int:
        return locked.get("/metrics", headers={"authorization": f"Bearer {tokens[scope]}"}).status_code

    until(lambda: (status("read"), status("act")) == (200, 403))
    locked.headers["authorization"] = f"Bearer {tokens['read']}"
    until(lambda: value(locked, "league_key_rejections_total", code="forbidden") >= 1)
    assert value(locked, "league_key_rejections_total", code="unauthenticated") >= 1


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
        server.metrics.count_request(str(api), "board", version, 1, 1)
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
    (sample,) = [
        sample
        for family in text_string_to_metric_families(render({"replica": report}).decode())
        for sample in family.samples
    ]
    assert sample.labels["league"] == 'a"b\\c\nd'
