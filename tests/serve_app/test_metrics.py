"""What Prometheus is told: every request once, whichever replica is asked."""

from collections.abc import Iterator

import numpy as np
import pytest
from prometheus_client.parser import text_string_to_metric_families
from prometheus_client.samples import Sample
from starlette.testclient import TestClient

from league.registry.registry import Registry
from league.registry.rows import Portion
from serve_app.app import Server
from serve_app.exposition import METRICS, text
from serve_app.metrics import KEPT, SIZES, Served
from tests.serve_app.conftest import QUICK, replica
from tests.serve_app.leagues import promote
from tests.serve_app.test_action import BOARD, act, boards
from tests.serve_app.test_alias_watcher import until


def samples(client: TestClient) -> list[Sample]:
    reply = client.get("/metrics")
    assert reply.status_code == 200, reply.text
    assert reply.headers["content-type"].startswith("text/plain; version=")
    return [sample for family in text_string_to_metric_families(reply.text) for sample in family.samples]


def value(client: TestClient, name: str, **labels: str) -> float:
    """The sum of a metric over all samples that have these labels."""
    return sum(s.value for s in samples(client) if s.name == name and labels.items() <= s.labels.items())


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


def test_swaps_and_the_live_version_are_told(client: TestClient, registry: Registry) -> None:
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
    registry.set_traffic("board", canary=Portion(2, 1.0), shadow=Portion(3, 1.0), actor="test", reason="test")
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


def test_whoever_is_asked_answers_for_all(registry: Registry) -> None:
    servers = [Server(Registry.open(registry.storage), QUICK, f"replica-{number}") for number in (1, 2)]
    with TestClient(servers[0].application()) as first, TestClient(servers[1].application()) as second:
        act(first, observation=BOARD)
        for _ in range(2):
            act(second, observation=BOARD)
        for client in (first, second):
            until(lambda client=client: value(client, "league_request_seconds_count") == 3)
            assert value(client, "league_request_seconds_count", replica="replica-1") == 1
        assert first.get("/v1/leagues/board/traffic").json()["all"]["versions"][0]["requests"] == 3
    with replica(registry.storage) as third:
        assert {sample.labels["replica"] for sample in samples(third)} <= {"replica-1"}, "those that stopped are gone"


@pytest.fixture
def locked(registry: Registry) -> Iterator[TestClient]:
    with replica(registry.storage, QUICK.model_copy(update={"require_keys": "always"})) as client:
        yield client


def test_metrics_take_a_key_that_reads_where_keys_are_asked_for(locked: TestClient, registry: Registry) -> None:
    tokens = {scope: registry.create_key(scope, [scope])[1] for scope in ("read", "act")}
    assert locked.get("/metrics").status_code == 401

    def status(scope: str) -> int:
        return locked.get("/metrics", headers={"authorization": f"Bearer {tokens[scope]}"}).status_code

    until(lambda: status("read") == 200)
    assert status("act") == 403
    locked.headers["authorization"] = f"Bearer {tokens['read']}"
    until(lambda: value(locked, "league_key_rejections_total", code="forbidden") == 1)
    assert value(locked, "league_key_rejections_total", code="unauthenticated") >= 1


def test_batch_sizes_fall_into_their_buckets() -> None:
    for rows in range(1, 1100):
        served = Served()
        served.add(rows, 1)
        assert served.sizes.index(1) == int(np.searchsorted(SIZES, rows))


@pytest.mark.anyio
async def test_counts_of_what_nobody_asks_for_are_forgotten(registry: Registry) -> None:
    server = Server(registry, QUICK, "replica-1")
    await server.live.follow({("board", "champion"): 1})
    version = server.live.champion("board")
    assert version is not None
    for api in range(KEPT + 5):
        server.metrics.answered(str(api), "board", version, 1, 1)
    assert len(server.metrics.report()["league_request_seconds"]) == KEPT


OF_NO_REPLICA = {"league_evaluations"}
"""What the route adds to the reports."""


@pytest.mark.anyio
async def test_every_report_is_of_metrics_that_there_are(registry: Registry) -> None:
    server = Server(registry, QUICK, "replica-1")
    assert server.metrics.report().keys() | OF_NO_REPLICA == METRICS.keys()


def test_labels_are_escaped() -> None:
    report = {"league_errors_total": [[['a"b\\c\nd', "code"], 1]]}
    (sample,) = [
        sample
        for family in text_string_to_metric_families(text({"replica": report}).decode())
        for sample in family.samples
    ]
    assert sample.labels["league"] == 'a"b\\c\nd'
