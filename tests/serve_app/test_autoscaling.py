"""A real server whose number of replicas follows the load, and what Ray says of it."""

import re
from pathlib import Path

import httpx
import pytest
import yaml

from benchmarks import autoscaling
from league.errors import NotReady
from league.registry.registry import Registry
from league.settings import Storage
from league.stack import VERIFIED
from serve_app.runtime.launch import DEPLOY_YAML, running
from tests.support.clients.actions import BOARD
from tests.support.leagues.served_leagues import everything
from tests.support.servers.under_load import ACTION, processes
from tests.support.waiting import until

pytestmark = pytest.mark.slow


@pytest.mark.timeout(600)
def test_a_second_replica_appears_under_load_and_goes_without_a_lost_call() -> None:
    # Other tests use the cores as well: a replica may not get 0.6 of one, and the cost of a request varies.
    following = autoscaling.follow(steady=3.0, target=0.3, first=1 / 4, factor=6)
    assert following.record.lost == []
    assert len(following.record.replicas) == 2
    assert set(following.record.statuses) <= {"429"}, "an overloaded replica sheds load; no connection is dropped"


@pytest.mark.timeout(300)
def test_the_metrics_of_ray_contain_actions(tmp_path: Path) -> None:
    """The count of requests, and the gauges that Ray's dashboard shows of autoscaling."""
    registry: Registry = everything(Storage.at(tmp_path / "home"))
    with running(registry.storage, replicas=1, max_replicas=2) as url, httpx.Client(trust_env=False) as client:
        (raylet,) = processes(registry.storage, "raylet/raylet")
        found = re.search(r"/[^\0]*/session_[\d_-]+", Path(f"/proc/{raylet}/cmdline").read_text())
        assert found is not None
        (port,) = Path(found[0]).glob("metrics_export_port_*")

        def total(metric: str, label: str = 'deployment="PolicyServer"') -> float:
            """The sum of a metric's samples with a label, after one more action."""
            client.post(f"{url}{ACTION}", json={"observation": BOARD}).raise_for_status()
            text = client.get(f"http://127.0.0.1:{port.read_text()}/metrics").text
            samples = re.findall(rf"^ray_serve_{metric}\{{(.*)\}} (\S+)$", text, flags=re.M)
            return sum(float(value) for labels, value in samples if label in labels)

        until(lambda: total("deployment_request_counter_total", 'route="/v1/policies/{model}/action"') > 0)
        until(lambda: total("autoscaling_desired_replicas") == total("autoscaling_target_replicas") == 1)
        until(lambda: total("autoscaling_total_requests") > 0)
    registry.close()


@pytest.mark.timeout(300)
def test_a_replica_with_another_stack_does_not_start(tmp_path: Path) -> None:
    document = yaml.safe_load(DEPLOY_YAML.read_text())
    document["applications"][0]["import_path"] = "tests.support.servers.other_stack:build_app"
    deploy = tmp_path / "deploy.yaml"
    deploy.write_text(yaml.safe_dump(document))
    message = f"has onnxruntime {VERIFIED['onnxruntime']}, the application was deployed with 1.2.3"
    with (
        pytest.raises(NotReady, match=re.escape(message)),
        running(Storage.at(tmp_path / "home"), replicas=1, deploy=deploy),
    ):
        pass
