"""Leagues with each element type of tensors, in addition to those of the action tests."""

import numpy as np
import onnx
from onnx import TensorProto, helper

from league.interface import AgentInterface
from league.registry.registry import Registry
from league.settings import Storage
from league.spaces import Box, DictSpace, Discrete
from tests.support.leagues.served_leagues import everything, promote, publish, register
from tests.support.policies.graphs import serialized, tensor

DTYPES = (
    ["bool", "int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64", "float16", "float32", "float64"]
)  # fmt: skip
PLANES, MOVES, FRAME = (8, 8, 111), 4672, (84, 84, 4)

KINDS = AgentInterface(
    observation=DictSpace(
        spaces={dtype: Box(dtype=dtype, shape=(2, 3), low=None, high=None) for dtype in DTYPES},
    ),
    action=Box(dtype="float32", shape=(len(DTYPES),), low=None, high=None),
)
CHESS = AgentInterface(
    observation=DictSpace(
        spaces={
            "observation": Box(dtype="bool", shape=PLANES, low=False, high=True),
            "action_mask": Box(dtype="int8", shape=(MOVES,), low=0, high=1),
        }
    ),
    action=Discrete(n=MOVES),
)
PISTONS = AgentInterface(
    observation=Box(dtype="uint8", shape=FRAME, low=0, high=255),
    action=Box(dtype="float32", shape=(1,), low=-1, high=1),
)
CHOICE = AgentInterface(observation=Discrete(n=4), action=Discrete(n=3))


def every_kind(storage: Storage) -> Registry:
    """The leagues of the action tests, and one for each tensor type of the shipped leagues."""
    registry = everything(storage)
    for league, spaces, graph in (
        ("kinds", KINDS, sums()),
        ("chess", CHESS, moves()),
        ("pistons", PISTONS, brightness()),
        ("choice", CHOICE, table()),
    ):
        register(registry, league, {"shared": spaces})
        publish(registry, league, {"shared": graph}, "run")
        promote(registry, league, 1)
    return registry


def sums() -> bytes:
    """The sum of the elements of each input."""
    nodes, parts = [], []
    for dtype in DTYPES:
        nodes += [
            helper.make_node("Cast", [f"observation.{dtype}"], [f"{dtype}_float"], to=TensorProto.FLOAT),
            helper.make_node("Flatten", [f"{dtype}_float"], [f"{dtype}_flat"], axis=1),
            helper.make_node("ReduceSum", [f"{dtype}_flat", "axis"], [f"{dtype}_sum"], keepdims=1),
        ]
        parts.append(f"{dtype}_sum")
    nodes.append(helper.make_node("Concat", parts, ["action"], axis=1))
    inputs = [tensor(f"observation.{dtype}", dtype, 2, 3) for dtype in DTYPES]
    return _graph(nodes, inputs, "float32", (len(DTYPES),), {"axis": np.array([1])}, dist_inputs="action")


def moves() -> bytes:
    """Prefers moves whose number is that of a set square of a plane, and masks illegal ones."""
    nodes = [
        helper.make_node("Cast", ["observation"], ["cast"], to=TensorProto.FLOAT),
        helper.make_node("Flatten", ["cast"], ["flat"], axis=1),
        helper.make_node("Slice", ["flat", "begin", "end", "axis"], ["logits"]),
        helper.make_node("Equal", ["action_mask", "illegal"], ["is_illegal"]),
        helper.make_node("Where", ["is_illegal", "low", "logits"], ["action_dist_inputs"]),
        helper.make_node("ArgMax", ["action_dist_inputs"], ["action"], axis=1, keepdims=0),
    ]
    inputs = [tensor("observation", "bool", *PLANES), tensor("action_mask", "int8", MOVES)]
    constants = {
        "begin": np.array([0]),
        "end": np.array([MOVES]),
        "axis": np.array([1]),
        "illegal": np.int8(0),
        "low": np.float32(-1e9),
    }
    return _graph(nodes, inputs, "int64", (), constants, width=MOVES)


def brightness() -> bytes:
    """The mean of a frame's bytes, in thousandths."""
    nodes = [
        helper.make_node("Cast", ["observation"], ["cast"], to=TensorProto.FLOAT),
        helper.make_node("Flatten", ["cast"], ["flat"], axis=1),
        helper.make_node("ReduceMean", ["flat", "axis"], ["mean"], keepdims=1),
        helper.make_node("Mul", ["mean", "scale"], ["action"]),
    ]
    constants = {"axis": np.array([1]), "scale": np.float32(0.001)}
    return _graph(nodes, [tensor("observation", "uint8", *FRAME)], "float32", (1,), constants, dist_inputs="action")


def table() -> bytes:
    """Logits looked up by observation."""
    nodes = [
        helper.make_node("Gather", ["table", "observation"], ["action_dist_inputs"], axis=0),
        helper.make_node("ArgMax", ["action_dist_inputs"], ["action"], axis=1, keepdims=0),
    ]
    logits = np.array([[0, 1, 2], [2, 1, 0], [0, 2, 1], [1, 0, 2]], np.float32)
    return _graph(nodes, [tensor("observation", "int64")], "int64", (), {"table": logits}, width=3)


def _graph(
    nodes: list[onnx.NodeProto],
    inputs: list[onnx.ValueInfoProto],
    dtype: str,
    shape: tuple[int, ...],
    constants: dict[str, np.ndarray | np.generic],
    width: int | None = None,
    dist_inputs: str | None = None,
) -> bytes:
    if dist_inputs:
        nodes.append(helper.make_node("Concat", [dist_inputs, dist_inputs], ["action_dist_inputs"], axis=1))
    outputs = [
        tensor("action", dtype, *shape),
        tensor("action_dist_inputs", "float32", width or 2 * shape[0]),
    ]
    return serialized(nodes, inputs, outputs, constants)
