"""A graph that does not end for an observation occupies a replica for a limited time."""

import asyncio
import threading
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from league.errors import ArtifactCorrupt
from league.policies import onnx
from league.policies.graph_runs import run_graph
from league.policies.onnx import OnnxPolicy
from league.policies.policy import Actions
from league.registry.registry import Registry
from serve_app.live_versions import version_cache
from serve_app.live_versions.version_cache import ActionSelections
from tests.support.clients.actions import BOARD, act, boards
from tests.support.leagues.served_leagues import publish
from tests.support.policies.graphs import ENDLESS, endless_mlp
from tests.support.servers.exposition import value
from tests.support.servers.replicas import replica
from tests.support.waiting import until

FULL = BOARD | {"observation": np.ones((6, 7, 2), int).tolist()}


@pytest.fixture
def _impatience(monkeypatch: pytest.MonkeyPatch) -> None:
    """Limits of runs that do not end are a 600th. All others need no limit, however busy the machine is."""

    def run_impatiently(session: Any, outputs: list[str], feed: dict[str, NDArray], seconds: float, owner: Any) -> Any:
        is_endless = feed.get("observation", np.zeros(1)).sum() == ENDLESS
        return run_graph(session, outputs, feed, seconds / 600 if is_endless else seconds, owner)

    monkeypatch.setattr(onnx, "run_graph", run_impatiently)


@pytest.mark.usefixtures("_impatience")
def test_a_request_gets_an_error_and_others_are_answered(registry: Registry) -> None:
    """In all protocols, on the event loop and in a thread."""
    version = publish(registry, "board", {"shared": endless_mlp()}, "run/endless").number
    path = f"/v1/policies/board/action?version={version}"
    infer = {
        "inputs": [
            {"name": name, "datatype": "INT8", "shape": [1, *np.shape(array)], "data": np.ravel(array).tolist()}
            for name, array in FULL.items()
        ]
    }
    with replica(registry.storage) as client:
        assert act(client, version=version, observation=BOARD)["version"] == version
        for _ in range(2):
            reply = client.post(path, json={"observation": FULL})
            assert (reply.status_code, reply.json()["code"]) == (504, "graph_timeout")
            assert "a run of the graph did not finish within 0.1 s" in reply.json()["message"]
            assert act(client, observation=boards(1)[0])["version"] == 1
        assert client.post(f"/v2/models/board/versions/{version}/infer", json=infer).status_code == 504
        with client.websocket_connect(f"/v1/policies/board/stream?version={version}") as stream:
            stream.send_json({"observation": FULL})
            assert stream.receive_json()["code"] == "graph_timeout"
            stream.send_json({"observation": BOARD})
            assert stream.receive_json()["version"] == version
        assert act(client, version=version, observation=BOARD)["version"] == version
        until(lambda: value(client, "league_errors_total", code="graph_timeout") == 4)


def test_a_version_that_does_not_end_is_not_loaded(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tests.support.policies.graphs.ENDLESS", 0)
    version = publish(registry, "board", {"shared": endless_mlp()}, "run/endless").number
    with pytest.raises(ArtifactCorrupt, match=r"policy shared of board@4 does not run: .* within 0.2 s"):
        version_cache.load(registry, "board", version, 0.001, ActionSelections(), timeout=0.2)


@pytest.mark.anyio
async def test_a_slow_policy_leaves_threads_to_others(registry: Registry) -> None:
    """Its callers wait for each other, not all others for them."""
    version = version_cache.load(registry, "board", 1, 0.0, ActionSelections())
    policy, ended = version.policy("shared"), threading.Event()
    policy.inline_rows = 0

    def act(graph: OnnxPolicy) -> Actions:
        ended.wait()
        return Actions(np.zeros(1))

    runs = [asyncio.create_task(policy.run(act, 1)) for _ in range(64)]
    try:
        await asyncio.sleep(0)
        assert await asyncio.wait_for(asyncio.to_thread(lambda: "answered"), timeout=60) == "answered"
        assert not any(run.done() for run in runs)
    finally:
        ended.set()
    await asyncio.gather(*runs)
