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


def nodes(*addresses: str, alive: bool = True) -> list[dict[str, object]]:
    """Nodes with these addresses. Their id is that of this node, the only one that can answer."""
    here = ray.get_runtime_context().get_node_id()
    return [{"NodeManagerAddress": address, "NodeID": here, "Alive": alive} for address in addresses]


@pytest.mark.usefixtures("ray_session")
def test_several_machines_need_shared_storage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ray, "nodes", lambda: nodes("192.0.2.1", "192.0.2.2"))
    with (
        pytest.raises(ConfigError, match=r"2 machines: set LEAGUE_DATABASE_URL .* LEAGUE_ARTIFACTS"),
        connected(None, Storage.at(tmp_path)),
    ):
        pass
    with connected(None, SHARED):
        pass


@pytest.mark.usefixtures("ray_session")
def test_dead_nodes_are_not_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = nodes("192.0.2.1") + nodes("192.0.2.2", alive=False)
    monkeypatch.setattr(ray, "nodes", lambda: found)
    with connected(None, Storage.at(tmp_path)):
        pass


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
    found = json.loads(process.stdout)
    assert found["resources"]["CPU"] == 1
    assert found["resources"]["object_store_memory"] == 100 * 10**6
    assert found["url"].startswith("http://127.0.0.1:")
    assert found["status"] == 200


@pytest.mark.parametrize("limits", [LocalRay(cpus=1), LocalRay(object_store=100), LocalRay(dashboard=True)])
def test_limits_apply_to_a_local_ray_only(tmp_path: Path, limits: LocalRay) -> None:
    with pytest.raises(ConfigError, match="for a local Ray"), connected("auto", Storage.at(tmp_path), limits):
        pass


def test_an_object_store_that_is_too_small_is_rejected(tmp_path: Path) -> None:
    process = subprocess.run(
        [sys.executable, "-c", LOCAL.replace("=100", "=50")], capture_output=True, text=True, timeout=DEADLINE
    )
    assert "ConfigError: --object-store: at least 80 MB, got 50" in process.stderr


def test_an_unreachable_cluster_is_reported_at_once() -> None:
    with pytest.raises(ConfigError, match=r"no Ray cluster at '127\.0\.0\.1:1'"):
        join("127.0.0.1:1")


def test_a_ray_that_does_not_start_is_reported_on_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def init(**_: object) -> None:
        raise Exception("The current node timed out\nduring startup.")

    monkeypatch.setattr(ray, "init", init)
    with pytest.raises(NotReady, match=r"^Ray did not start: The current node timed out during startup\.$"):
        start_local(LocalRay(cpus=1))


def test_only_one_module_initializes_ray() -> None:
    root = Path(__file__).parents[2]
    packages = ("evaluation", "league", "policy_league", "serve_app", "training")
    callers = [path for name in packages for path in (root / name).rglob("*.py") if "ray.init(" in path.read_text()]
    assert callers == [root / "league/ray_cluster.py"]


@pytest.mark.parametrize(
    ("files", "expected"),
    [
        ({"cpu.max": "250000 100000\n"}, 3),
        ({"cpu.max": "max 100000\n"}, 8),
        ({"cpu.max": "50000 100000\n"}, 1),
        ({"cpu/cpu.cfs_quota_us": "200000\n", "cpu/cpu.cfs_period_us": "100000\n"}, 2),
        ({"cpu/cpu.cfs_quota_us": "-1\n", "cpu/cpu.cfs_period_us": "100000\n"}, 8),
        ({}, 8),
    ],
    ids=["2.5 CPUs", "no limit", "half a CPU", "version 1", "version 1, no limit", "no control groups"],
)
def test_a_container_uses_no_more_cpus_than_its_limit(
    files: dict[str, str], expected: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ray_cluster, "CGROUP", tmp_path)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)))
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    assert ray_cluster.usable_cpus() == expected


@pytest.mark.usefixtures("ray_session")
def test_a_local_ray_has_neither_an_autoscaler_nor_nodes_that_leave() -> None:
    """Tests have one node with two CPUs."""
    assert (ray_cluster.has_autoscaler(), ray_cluster.draining_nodes()) == (False, set())
    (node,) = ray_cluster.usable_nodes()
    assert ray_cluster.cluster_cpus() == 2
    assert ray_cluster.node_cpus({node["NodeID"], "left"}) == {node["NodeID"]: 2.0}


def test_a_machine_with_another_version_is_refused() -> None:
    ours = ray_cluster.installed_with_this()
    ray_cluster.check_stack(ours, "10.0.0.2")
    ray_cluster.check_stack({**ours, "torch": ours["torch"].partition("+")[0] + "+cu130"}, "10.0.0.2")
    ray_cluster.check_stack({"ray": ours["ray"]}, "10.0.0.2")
    for package in ("onnxruntime", "policy-league"):
        with pytest.raises(ConfigError, match=rf"10\.0\.0\.2 has {package} 0\.0\.7, this one has {ours[package]}:"):
            ray_cluster.check_stack({**ours, package: "0.0.7"}, "10.0.0.2")


def test_a_replica_on_a_machine_with_another_version_is_refused() -> None:
    ours = ray_cluster.installed_with_this()
    ray_cluster.check_deployed_stack(ours, "10.0.0.2")
    message = rf"10\.0\.0\.2 has ray {ours['ray']}, the application was deployed with 2\.59\.0: install the same"
    with pytest.raises(ConfigError, match=message):
        ray_cluster.check_deployed_stack({**ours, "ray": "2.59.0"}, "10.0.0.2")
