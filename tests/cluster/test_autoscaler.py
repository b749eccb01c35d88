"""Training on nodes that Ray's own autoscaler adds."""

import secrets
from pathlib import Path

import pytest

from tests.support.cluster import autoscaled_head, machines, scenarios
from tests.support.cluster.league_cluster import LEAGUE, START_TIMEOUT
from tests.support.cluster.machines import ROOT, network

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]


def test_training_waits_for_the_nodes_that_it_requests(tmp_path: Path) -> None:
    """Without an autoscaler, training would be refused: the cluster has no CPU."""
    if (reason := machines.obstacle()) is not None:
        pytest.skip(reason)
    environment = {
        "PYTHONPATH": str(ROOT),
        "LEAGUE_HOME": str(tmp_path / "home"),
        "RAY_AUTH_MODE": "token",
        "RAY_AUTH_TOKEN": secrets.token_hex(16),
        "RAY_DISABLE_DOCKER_CPU_WARNING": "1",
        "COLUMNS": "200",
    }
    config = str(scenarios.write_config(tmp_path, runners=1, steps=2048))
    with network(["head"], tmp_path) as members:
        head = members["head"]
        autoscaled_head.start(head, tmp_path / "autoscaler.json", environment)
        command = (LEAGUE, "train", config, "--address", f"{head.address}:6379")
        output = head.check_run(*command, environment=environment, timeout=2 * START_TIMEOUT)
    assert "Ray's autoscaler is asked for 2 CPUs; the cluster has 0." in output
    assert "Training on 1 of 1 nodes, 2 of 2 CPUs." in output
    assert f"Published {scenarios.LEAGUE}@1" in output
