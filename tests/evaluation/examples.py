"""Checkpoint versions of tic-tac-toe whose strength is known: small graphs, put together by hand.

A graph sees, on each of the eight lines, whether its own side or the opponent has two marks there, and prefers the
squares of such lines over a fixed order of squares. `wins` and `blocks` say which of the two it heeds.
"""

from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from onnx import TensorProto, helper, numpy_helper

from league.config import LeagueConfig
from league.environments.building import interface
from league.registry.manifest import Manifest, Parity, PolicyManifest, Tensor
from league.registry.registry import Registry
from league.registry.rows import VersionRow
from league.settings import Storage

LEAGUE = "tictactoe"
LINES = ((0, 1, 2), (3, 4, 5), (6, 7, 8), (0, 3, 6), (1, 4, 7), (2, 5, 8), (0, 4, 8), (2, 4, 6))
CENTRE_FIRST = (4, 0, 2, 6, 8, 1, 3, 5, 7)
EDGES_FIRST = (1, 3, 5, 7, 8, 6, 2, 0, 4)


def config(**parts: object) -> LeagueConfig:
    document = {
        "league": LEAGUE,
        "environment": {"entry_point": "pettingzoo.classic.tictactoe_v3"},
        "play": {"opening_plies": 2},
        "gate": {"elo1": 100, "max_blocks": 300},
    }
    return LeagueConfig.from_mapping(document | parts)


def registry(home: Path, **parts: object) -> Registry:
    """A registry with the league in it, and no versions."""
    league = config(**parts)
    opened = Registry.open(Storage.at(home))
    opened.register(league, interface(league))
    return opened


def publish(registry: Registry, graph: bytes) -> VersionRow:
    number = len(registry.versions(LEAGUE))
    return registry.publish(LEAGUE, _builder(registry, graph), source=f"hand/{number}", parent=None)


def graph(wins: bool = False, blocks: bool = False, order: tuple[int, ...] = EDGES_FIRST) -> bytes:
    """An ONNX graph with the interface of a checkpoint's: observation, action_mask → action, action_dist_inputs."""
    see = np.zeros((18, 16), np.float32)
    heed = np.zeros((16, 9), np.float32)
    for i, line in enumerate(LINES):
        for square in line:
            see[2 * square, i] = see[2 * square + 1, 8 + i] = 1.0
            heed[i, square] = 200.0 * wins
            heed[8 + i, square] = 20.0 * blocks
    weights = {
        "see": see,
        "more_than_one": np.full(16, -1.0, np.float32),
        "heed": heed,
        "order": -np.argsort(order).astype(np.float32),
        "flat": np.array([-1, 18], np.int64),
        "illegal": np.array(np.finfo(np.float32).min, np.float32),
    }
    nodes = [
        helper.make_node("Cast", ["observation"], ["planes"], to=TensorProto.FLOAT),
        helper.make_node("Reshape", ["planes", "flat"], ["squares"]),
        helper.make_node("MatMul", ["squares", "see"], ["marks"]),
        helper.make_node("Add", ["marks", "more_than_one"], ["excess"]),
        helper.make_node("Relu", ["excess"], ["pairs"]),
        helper.make_node("MatMul", ["pairs", "heed"], ["urgent"]),
        helper.make_node("Add", ["urgent", "order"], ["wanted"]),
        helper.make_node("Cast", ["action_mask"], ["legal"], to=TensorProto.BOOL),
        helper.make_node("Where", ["legal", "wanted", "illegal"], ["action_dist_inputs"]),
        helper.make_node("ArgMax", ["action_dist_inputs"], ["action"], axis=1, keepdims=0),
    ]
    body = helper.make_graph(
        nodes,
        "by_hand",
        [
            helper.make_tensor_value_info("observation", TensorProto.INT8, ["batch", 3, 3, 2]),
            helper.make_tensor_value_info("action_mask", TensorProto.INT8, ["batch", 9]),
        ],
        [
            helper.make_tensor_value_info("action", TensorProto.INT64, ["batch"]),
            helper.make_tensor_value_info("action_dist_inputs", TensorProto.FLOAT, ["batch", 9]),
        ],
        [numpy_helper.from_array(value, name) for name, value in weights.items()],
    )
    model = helper.make_model(body, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    return bytes(model.SerializeToString())


def _builder(registry: Registry, graph: bytes) -> Callable[[Path, int], Manifest]:
    row = registry.league(LEAGUE)
    spaces = row.interface.of_policy("shared")

    def build(directory: Path, number: int) -> Manifest:
        (directory / "shared.onnx").write_bytes(graph)
        policy = PolicyManifest(
            file="shared.onnx",
            observation=spaces.observation,
            action=spaces.action,
            inputs=(
                Tensor(name="observation", dtype="int8", shape=(None, 3, 3, 2)),
                Tensor(name="action_mask", dtype="int8", shape=(None, 9)),
            ),
            outputs=(
                Tensor(name="action", dtype="int64", shape=(None,)),
                Tensor(name="action_dist_inputs", dtype="float32", shape=(None, 9)),
            ),
            parity=Parity(observations=2000, mismatches=0, near_ties=0, max_difference=0.0),
        )
        return Manifest(
            league=LEAGUE,
            version=number,
            created_at=datetime.now(UTC),
            interface=row.interface,
            policies={"shared": policy},
            environment=row.config.environment,
            environment_digest=row.environment_digest,
            algorithm="ppo",
            settings={},
            seed=0,
            steps=number,
            stack={},
        )

    return build
