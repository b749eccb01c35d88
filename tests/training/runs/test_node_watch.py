"""When a run shows its nodes and its simulators, and when it moves to other nodes."""

from dataclasses import replace

import pytest
import ray
from ray.exceptions import RpcError

from league import ray_cluster
from league.registry.registry import Registry
from league.registry.storage.rows import Gateway
from tests.support.leagues.registries import LEAGUE
from training.algorithms.resources import Resources
from training.runs import node_watch, simulator_watch, tune
from training.runs.node_watch import NodeWatch
from training.runs.simulator_watch import SimulatorWatch


class Nodes:
    """A cluster whose nodes are named by letters, with two CPUs and a GPU each but for the head.

    The run has two runners.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch, share: float, gpus: float = 0.0) -> None:
        self.alive, self.draining = "ab", set[str]()
        self.said: list[str] = []
        self.moves = 0
        self.watch = NodeWatch(Resources(2, num_envs=1, threads=1, gpus=gpus), share, self.said.append, self._move)
        monkeypatch.setattr(ray, "nodes", self._nodes)
        monkeypatch.setattr(ray_cluster, "draining_nodes", lambda: self.draining)
        monkeypatch.setattr(node_watch, "draining_nodes", lambda: self.draining)
        monkeypatch.setattr(tune, "has_autoscaler", lambda: False)
        monkeypatch.setattr(node_watch, "NODE_POLL", 0.0)

    def _nodes(self) -> list[dict[str, object]]:
        head = {"NodeID": "head", "Alive": True, "Resources": {"memory": 1.0}}
        return [head, *({"NodeID": name, "Alive": True, "Resources": {"CPU": 2.0, "GPU": 1.0}} for name in self.alive)]

    def _move(self) -> None:
        self.moves += 1

    def run_on(self, nodes: str) -> None:
        self.watch.on_trial_result(result={"nodes": list(nodes)})
        self.look()

    def look(self) -> None:
        self.watch.on_step_begin()


def test_the_nodes_are_shown_as_they_change(monkeypatch: pytest.MonkeyPatch) -> None:
    nodes = Nodes(monkeypatch, share=1.0)
    nodes.look()
    assert nodes.said == [], "nothing runs yet"
    nodes.run_on("ab")
    nodes.look()
    nodes.alive = "abc"
    nodes.look()
    assert nodes.said == ["Training on 2 of 2 nodes, 3 of 4 CPUs.", "Training on 2 of 3 nodes, 3 of 6 CPUs."]
    assert (nodes.moves, nodes.watch.reason) == (0, None)


def test_the_gpus_of_a_run_are_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    nodes = Nodes(monkeypatch, share=1.0, gpus=1.5)
    nodes.run_on("ab")
    assert nodes.said == ["Training on 2 of 2 nodes, 3 of 4 CPUs, 1.5 of 2 GPUs."]


def test_a_run_leaves_a_node_that_is_drained(monkeypatch: pytest.MonkeyPatch) -> None:
    nodes = Nodes(monkeypatch, share=1.0)
    nodes.alive = "abc"
    nodes.run_on("ab")
    nodes.draining = {"c"}
    nodes.look()
    assert nodes.moves == 0, "it is not on that node"
    nodes.draining = {"b"}
    nodes.look()
    nodes.look()
    assert (nodes.moves, nodes.watch.reason) == (1, "1 of 2 nodes are drained")


def test_a_run_moves_if_its_processes_get_more_cpus(monkeypatch: pytest.MonkeyPatch) -> None:
    nodes = Nodes(monkeypatch, share=0.66)
    nodes.alive = "a"
    nodes.run_on("a")
    assert nodes.said == ["Training on 1 of 1 nodes, 1.98 of 2 CPUs."]
    nodes.alive = "ab"
    nodes.look()
    assert (nodes.moves, nodes.watch.reason) == (1, "nodes have joined")


def test_nothing_happens_while_the_head_restarts(monkeypatch: pytest.MonkeyPatch) -> None:
    nodes = Nodes(monkeypatch, share=0.66)

    def fail() -> set[str]:
        raise RpcError("the head does not answer")

    monkeypatch.setattr(ray_cluster, "draining_nodes", fail)
    nodes.run_on("ab")
    assert (nodes.said, nodes.moves) == ([], 0)


def test_a_run_stays_while_all_nodes_with_cpus_have_left(monkeypatch: pytest.MonkeyPatch) -> None:
    nodes = Nodes(monkeypatch, share=0.66)
    nodes.alive = ""
    nodes.run_on("a")
    assert nodes.moves == 0


TRAINING = Gateway("ws://127.0.0.1:8001", "secret", LEAGUE, "training")


def test_changes_are_said_once(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(simulator_watch, "POLL", 0.0)
    lines: list[str] = []
    watch = SimulatorWatch(registry, LEAGUE, lines.append)
    registry.gateways.announce(replace(TRAINING, url="ws://127.0.0.1:8002", purpose="evaluation"))
    watch.on_step_begin()
    assert lines == []
    address = f"Simulators of league {LEAGUE} connect to the server, or here: ws://127.0.0.1:8001 with the key secret"
    waits = "The run waits for simulators. Its minutes do not pass."
    for simulators, said in (
        (0, [address, waits]),
        (0, []),
        (1, ["1 simulator is connected."]),
        (3, ["3 simulators are connected."]),
        (0, [waits]),
    ):
        registry.gateways.announce(replace(TRAINING, simulators=simulators))
        lines.clear()
        watch.on_step_begin()
        assert lines == said


def test_a_gateway_on_a_cluster_is_said_to_be_out_of_reach(registry: Registry) -> None:
    lines: list[str] = []
    registry.gateways.announce(TRAINING)
    SimulatorWatch(registry, LEAGUE, lines.append, machines=3).on_step_begin()
    assert "The cluster has 3 machines, and only the one of the run's runner reaches this address" in lines[1]


def test_the_registry_is_not_asked_at_each_step(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(simulator_watch, "POLL", 3600.0)
    lines: list[str] = []
    watch = SimulatorWatch(registry, LEAGUE, lines.append)
    watch.on_step_begin()
    registry.gateways.announce(TRAINING)
    watch.on_step_begin()
    assert lines == []
