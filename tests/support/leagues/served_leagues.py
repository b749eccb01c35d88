"""Leagues with each kind of space, published from small handwritten graphs."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from onnx import TensorProto, helper

from league.conditions import ActionSelection
from league.config.league import LeagueConfig
from league.interface import AgentInterface, Interface
from league.policies.probes import Probes
from league.registry.aliases import ANY
from league.registry.registry import Registry
from league.registry.storage.manifest import PROBES, Manifest
from league.registry.storage.rows import VersionRow
from league.settings import Storage
from league.spaces import Box, DictSpace, Discrete
from tests.support.leagues.manifests import manifest, policy_manifest
from tests.support.policies.graphs import continuous, counting, masked_mlp, serialized, tensor
from tests.support.templates import copy_of

BOARD = AgentInterface(
    observation=DictSpace(
        spaces={
            "observation": Box(dtype="int8", shape=(6, 7, 2), low=0, high=1),
            "action_mask": Box(dtype="int8", shape=(7,), low=0, high=1),
        }
    ),
    action=Discrete(n=7),
)
MEMORY = AgentInterface(observation=Box(dtype="float32", shape=(1,), low=None, high=None), action=Discrete(n=2))
VECTOR = AgentInterface(
    observation=Box(dtype="float32", shape=(2,), low=-1, high=1),
    action=Box(dtype="float32", shape=(2,), low=-1, high=1),
)
NESTED = AgentInterface(
    observation=DictSpace(
        spaces={
            "mode": Discrete(n=3, start=1),
            "sense": DictSpace(spaces={"speed": Box(dtype="float32", shape=(2,), low=None, high=None)}),
        }
    ),
    action=Discrete(n=2),
)


def nested() -> bytes:
    """Whether the sum of the speeds times the mode is positive."""
    nodes = [
        helper.make_node("ReduceSum", ["observation.sense.speed", "axis"], ["sum"], keepdims=0),
        helper.make_node("Cast", ["observation.mode"], ["mode"], to=TensorProto.FLOAT),
        helper.make_node("Mul", ["sum", "mode"], ["product"]),
        helper.make_node("Unsqueeze", ["product", "axis"], ["column"]),
        helper.make_node("Neg", ["column"], ["negative"]),
        helper.make_node("Concat", ["negative", "column"], ["action_dist_inputs"], axis=1),
        helper.make_node("ArgMax", ["action_dist_inputs"], ["action"], axis=1, keepdims=0),
    ]
    inputs = [tensor("observation.mode", "int64"), tensor("observation.sense.speed", "float32", 2)]
    outputs = [tensor("action", "int64"), tensor("action_dist_inputs", "float32", 2)]
    return serialized(nodes, inputs, outputs, {"axis": np.array([1])})


def interface(policies: dict[str, AgentInterface]) -> Interface:
    """One agent for each policy."""
    agents = {f"agent_{policy}": spaces for policy, spaces in policies.items()}
    return Interface(
        agents=agents,
        policies={f"agent_{policy}": policy for policy in policies},
        sides={agent: (agent,) for agent in agents},
    )


def register(
    registry: Registry, league: str, policies: dict[str, AgentInterface], actions: ActionSelection | None = None
) -> None:
    registry.leagues.register(_config(league, actions), interface(policies))


def publish(
    registry: Registry,
    league: str,
    graphs: dict[str, bytes],
    source: str,
    probes: dict[str, Probes] | None = None,
    algorithm: str = "ppo",
) -> VersionRow:
    """Publish a version of a registered league with these graphs, by policy, and optionally their probes."""
    return registry.publisher.publish(
        league, _builder(registry, league, graphs, probes or {}, algorithm), source=source
    )


def promote(registry: Registry, league: str, version: int) -> None:
    """Promote like `league promote`."""
    registry.aliases.set(league, "champion", version, expected=ANY, actor="test", reason="test")


def everything(storage: Storage) -> Registry:
    """A registry with a league of each kind: `board` with three versions, the first of them its champion."""
    return copy_of(build_everything, storage)


def build_everything(storage: Storage) -> Registry:
    """Like `everything`, but newly published, with other digests."""
    registry = Registry.open(storage)
    register(registry, "board", {"shared": BOARD})
    for seed in range(3):
        publish(registry, "board", {"shared": masked_mlp(seed=seed)}, f"run/{seed}")
    register(registry, "duo", {"left": BOARD, "right": BOARD})
    publish(registry, "duo", {"left": masked_mlp(seed=3), "right": masked_mlp(seed=4)}, "run")
    for league, spaces, graph in (
        ("memory", MEMORY, counting()),
        ("vector", VECTOR, continuous()),
        ("nested", NESTED, nested()),
        ("headless", BOARD, masked_mlp()),
    ):
        register(registry, league, {"shared": spaces})
        publish(registry, league, {"shared": graph}, "run")
    register(registry, "empty", {"shared": BOARD})
    for league in ("board", "duo", "memory", "vector", "nested"):
        promote(registry, league, 1)
    return registry


def _config(league: str, actions: ActionSelection | None = None) -> LeagueConfig:
    environment, play = {"entry_point": "games.none:none"}, {"actions": actions}
    return LeagueConfig.from_mapping({"league": league, "environment": environment, "play": play})


def _builder(
    registry: Registry, league: str, graphs: dict[str, bytes], probes: dict[str, Probes], algorithm: str
) -> Callable[[Path, int], Manifest]:
    row = registry.leagues.get(league)

    def build(directory: Path, number: int) -> Manifest:
        (directory / "training").mkdir()
        (directory / "training" / "state").write_bytes(b"weights of the trainer")
        for policy, graph in graphs.items():
            (directory / f"{policy}.onnx").write_bytes(graph)
        for policy, recorded in probes.items():
            (directory / f"{policy}{PROBES}").write_bytes(recorded.to_bytes())
        policies = {
            policy: policy_manifest(
                row.interface.of_policy(policy), policy, graph, probes=f"{policy}{PROBES}" if policy in probes else None
            )
            for policy, graph in graphs.items()
        }
        return manifest(row, number, policies, algorithm=algorithm)

    return build
