import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import ray

from league import ray_cluster
from league.errors import ConfigError, NotReady
from league.ray_cluster import LocalRay, connected, join, start_local
from league.settings import Storage

DEADLINE = 120


SHARED = Storage(Path("/home/x"), "postgresql://db/league", Path("/mnt/artifacts"))


@pytest.mark.slow
@pytest.mark.usefixtures("ray_session")
def test_a_ray_of_the_caller_remains_running(tmp_path: Path) -> None:
    with connected(None, Storage.at(tmp_path)):
        pass
    assert ray.is_initialized()


LOCAL = """
import json, httpx, ray
from pathlib import Path
from league.settings import Storage
from league.ray_cluster import LocalRay, connected
with connected(None, Storage.at("here"), LocalRay(cpus=1, object_store=100, dashboard=True)) as url:
    print(json.dumps({
        "resources": ray.cluster_resources(), "status": httpx.get(url, timeout=60).status_code, "url": url,
    }))
assert not ray.is_initialized()
"""


@pytest.mark.slow
def test_a_local_ray_has_limits_and_a_dashboard() -> None:
    process = subprocess.run([sys.executable, "-c", LOCAL], capture_output=True, text=True, timeout=DEADLINE)
    assert process.returncode == 0, process.stderr
    printed = json.loads(process.stdout)
    assert printed["resources"]["CPU"] == 1
    assert printed["resources"]["object_store_memory"] == 100 * 10**6
    assert printed["url"].startswith("http://127.0.0.1:")
    assert printed["status"] == 200


def test_an_object_store_that_is_too_small_is_rejected() -> None:
    with pytest.raises(ConfigError, match="--object-store: at least 80 MB, got 50"):
        LocalRay(object_store=50)


def test_a_ray_that_does_not_start_is_reported_on_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def init(**_: object) -> None:
        raise Exception(fault)

    monkeypatch.setattr(ray, "init", init)
    fault = "The current node timed out\nduring startup."
    with pytest.raises(NotReady, match=r"^Ray did not start: The current node timed out during startup\.$"):
        start_local(LocalRay(cpus=1))
    fault = "validate_socket_filename failed: AF_UNIX path length cannot exceed 107 bytes: /tmp/ddd/plasma_store"
    with pytest.raises(NotReady, match=r"plasma_store: set RAY_TMPDIR to a shorter path, such as /tmp$"):
        start_local(LocalRay(cpus=1))


def test_only_one_module_initializes_ray() -> None:
    root = Path(__file__).parents[2]
    packages = ("evaluation", "league", "policy_league", "serve_app", "training")
    callers = [path for name in packages for path in (root / name).rglob("*.py") if "ray.init(" in path.read_text()]
    assert callers == [root / "league/ray_cluster.py"]


@pytest.mark.usefixtures("ray_session")
def test_a_local_ray_has_neither_an_autoscaler_nor_nodes_that_leave() -> None:
    """Tests have one node with two CPUs."""
    assert (ray_cluster.has_autoscaler(), ray_cluster.draining_nodes()) == (False, set())
    (node,) = ray_cluster.usable_nodes()
    assert ray_cluster.cluster_cpus() == 2
    assert ray_cluster.node_cpus({node["NodeID"], "left"}) == {node["NodeID"]: 2.0}


@pytest.mark.usefixtures("ray_session")
def test_several_machines_need_shared_storage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Dead nodes are not counted."""
    node = ray.get_runtime_context().get_node_id()  # the only one that can answer

    def connect(storage: Storage, is_second_alive: bool) -> None:
        nodes = [("192.0.2.1", True), ("192.0.2.2", is_second_alive)]
        rows = [{"NodeManagerAddress": address, "NodeID": node, "Alive": alive} for address, alive in nodes]
        monkeypatch.setattr(ray, "nodes", lambda: rows)
        with connected(None, storage):
            pass

    with pytest.raises(ConfigError, match=r"2 machines: set LEAGUE_DATABASE_URL .* LEAGUE_ARTIFACTS"):
        connect(Storage.at(tmp_path), is_second_alive=True)
    connect(SHARED, is_second_alive=True)
    connect(Storage.at(tmp_path), is_second_alive=False)


def test_a_cluster_has_no_local_limits_and_must_be_reachable(tmp_path: Path) -> None:
    for limits in (LocalRay(cpus=1), LocalRay(object_store=100), LocalRay(dashboard=True)):
        with pytest.raises(ConfigError, match="for a local Ray"), connected("auto", Storage.at(tmp_path), limits):
            pass
    with pytest.raises(ConfigError, match=r"no Ray cluster at '127\.0\.0\.1:1'"):
        join("127.0.0.1:1")


def test_a_container_uses_no_more_cpus_than_its_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)))
    quota, period = "cpu/cpu.cfs_quota_us", {"cpu/cpu.cfs_period_us": "100000\n"}  # of version 1
    for number, (files, expected) in enumerate(
        (
            ({"cpu.max": "250000 100000\n"}, 3),
            ({"cpu.max": "max 100000\n"}, 8),
            ({"cpu.max": "50000 100000\n"}, 1),
            ({quota: "200000\n", **period}, 2),
            ({quota: "-1\n", **period}, 8),
            ({}, 8),
        )
    ):
        monkeypatch.setattr(ray_cluster, "CGROUP", tmp_path / str(number))
        for name, text in files.items():
            path = tmp_path / str(number) / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
        assert ray_cluster.usable_cpus() == expected


def test_a_machine_with_another_version_is_refused() -> None:
    ours = ray_cluster.installed_with_this()
    for stack in (ours, {**ours, "torch": ours["torch"].partition("+")[0] + "+cu130"}, {"ray": ours["ray"]}):
        ray_cluster.check_stack(stack, "10.0.0.2")
    for package in ("onnxruntime", "policy-league"):
        with pytest.raises(ConfigError, match=rf"10\.0\.0\.2 has {package} 0\.0\.7, this one has {ours[package]}:"):
            ray_cluster.check_stack({**ours, package: "0.0.7"}, "10.0.0.2")
    ray_cluster.check_deployed_stack(ours, "10.0.0.2")
    message = rf"10\.0\.0\.2 has ray {ours['ray']}, the application was deployed with 2\.59\.0: install the same"
    with pytest.raises(ConfigError, match=message):
        ray_cluster.check_deployed_stack({**ours, "ray": "2.59.0"}, "10.0.0.2")
