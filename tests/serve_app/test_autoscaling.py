"""A real server whose number of replicas follows the load, and a replica with another stack."""

import re
from pathlib import Path

import pytest
import yaml

from benchmarks import autoscaling
from league.errors import NotReady
from league.settings import Storage
from league.stack import VERIFIED
from serve_app.runtime.launch import DEPLOY_YAML, running

pytestmark = pytest.mark.slow


@pytest.mark.timeout(600)
def test_a_second_replica_appears_under_load_and_goes_without_a_lost_call() -> None:
    # Other tests use the cores as well: a replica may get no more than a third of one.
    following = autoscaling.follow(steady=3.0, target=0.3, first=1 / 8, factor=10)
    assert following.record.lost == []
    assert len(following.record.replicas) == 2
    assert set(following.record.statuses) <= {"429"}, "an overloaded replica sheds load; no connection is dropped"


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
