"""ONNX graphs written by hand, with the interface of exported graphs."""

from collections.abc import Mapping, Sequence

import numpy as np
import onnx
from onnx import TensorProto, ValueInfoProto, helper, numpy_helper


def tensor(name: str, dtype: str, *shape: int) -> ValueInfoProto:
    """An input or output of a graph, for each row of a batch."""
    return helper.make_tensor_value_info(name, helper.np_dtype_to_tensor_dtype(np.dtype(dtype)), ["batch", *shape])


def masked_mlp(
    shape: Sequence[int] = (6, 7, 2),
    actions: int = 7,
    hidden: Sequence[int] = (16,),
    seed: int = 0,
    start: int = 0,
    *,
    has_value: bool = False,
) -> bytes:
    """Observation and mask (int8) to logits, -1e9 for illegal actions, and their arg max plus `start`.

    has_value: whether there is a third output, `value`, from the last hidden layer.
    """
    random, width, name = np.random.default_rng(seed), int(np.prod(shape)), "flat"
    nodes = [
        helper.make_node("Cast", ["observation"], ["cast"], to=TensorProto.FLOAT),
        helper.make_node("Flatten", ["cast"], ["flat"], axis=1),
    ]
    constants: dict[str, np.ndarray | np.generic] = {
        "start": np.int64(start),
        "zero": np.int8(0),
        "low": np.float32(-1e9),
    }
    for i, units in enumerate((*hidden, actions)):
        constants[f"w{i}"] = (random.normal(size=(width, units)) / np.sqrt(width)).astype(np.float32)
        nodes.append(helper.make_node("MatMul", [name, f"w{i}"], [f"z{i}"]))
        nodes.append(helper.make_node("Tanh", [f"z{i}"], [f"a{i}"]))
        last_hidden, (width, name) = (width, name), (units, f"a{i}")
    nodes += [
        helper.make_node("Equal", ["action_mask", "zero"], ["illegal"]),
        helper.make_node("Where", ["illegal", "low", name], ["action_dist_inputs"]),
        helper.make_node("ArgMax", ["action_dist_inputs"], ["best"], axis=1, keepdims=0),
        helper.make_node("Add", ["best", "start"], ["action"]),
    ]
    inputs = [tensor("observation", "int8", *shape), tensor("action_mask", "int8", actions)]
    outputs = [tensor("action", "int64"), tensor("action_dist_inputs", "float32", actions)]
    if has_value:
        width, name = last_hidden
        constants["wv"] = (random.normal(size=width) / np.sqrt(width)).astype(np.float32)
        nodes += [helper.make_node("MatMul", [name, "wv"], ["zv"]), helper.make_node("Tanh", ["zv"], ["value"])]
        outputs.append(tensor("value", "float32"))
    return serialized(nodes, inputs, outputs, constants)


ENDLESS = 84
"""Sum of the observation for which `endless_mlp` does not end: all of `masked_mlp`'s default shape are ones."""


def endless_mlp(seed: int = 0) -> bytes:
    """`masked_mlp` with a loop that does not end if the first observation of a batch sums to ENDLESS."""
    model = onnx.load_from_string(masked_mlp(seed=seed))
    turn, count, following = (
        helper.make_tensor_value_info(name, TensorProto.INT64, []) for name in ("turn", "count", "next")
    )
    on, still = (helper.make_tensor_value_info(name, TensorProto.BOOL, []) for name in ("on", "still"))
    steps = [helper.make_node("Identity", ["on"], ["still"]), helper.make_node("Mul", ["count", "turn"], ["next"])]
    body = helper.make_graph(steps, "body", [turn, on, count], [still, following])
    *nodes, last = model.graph.node
    loop = [
        helper.make_node("ReduceSum", ["flat", "columns"], ["sums"], keepdims=0),
        helper.make_node("Gather", ["sums", "nothing"], ["sum"]),
        helper.make_node("Equal", ["sum", "endless"], ["begins"]),
        helper.make_node("Loop", ["", "begins", "nothing"], ["none"], body=body),
        helper.make_node("Add", ["start", "none"], ["moved"]),
    ]
    last.input[1] = "moved"
    del model.graph.node[:]
    model.graph.node.extend([*nodes, *loop, last])
    for name, value in (("columns", [1]), ("nothing", 0)):
        model.graph.initializer.append(numpy_helper.from_array(np.array(value, np.int64), name))
    model.graph.initializer.append(numpy_helper.from_array(np.float32(ENDLESS), "endless"))
    onnx.checker.check_model(model)
    return model.SerializeToString()


def counting() -> bytes:
    """A recurrent graph: `state_out_0` is the sum of all observations; the action is whether it exceeds 2."""
    nodes = [
        helper.make_node("Mul", ["observation", "zero"], ["zeros"]),
        helper.make_node("Add", ["zeros", "limit"], ["two"]),
        helper.make_node("Add", ["observation", "state_in_0"], ["state_out_0"]),
        helper.make_node("Concat", ["two", "state_out_0"], ["action_dist_inputs"], axis=1),
        helper.make_node("ArgMax", ["action_dist_inputs"], ["action"], axis=1, keepdims=0),
    ]
    inputs = [tensor("observation", "float32", 1), tensor("state_in_0", "float32", 1)]
    outputs = [
        tensor("action", "int64"),
        tensor("action_dist_inputs", "float32", 2),
        tensor("state_out_0", "float32", 1),
    ]
    return serialized(nodes, inputs, outputs, {"zero": np.float32(0), "limit": np.float32(2)})


def memoryless() -> bytes:
    """`counting` without the sum: the action is whether the observation exceeds 2."""
    nodes = [
        helper.make_node("Mul", ["observation", "zero"], ["zeros"]),
        helper.make_node("Add", ["zeros", "limit"], ["two"]),
        helper.make_node("Concat", ["two", "observation"], ["action_dist_inputs"], axis=1),
        helper.make_node("ArgMax", ["action_dist_inputs"], ["action"], axis=1, keepdims=0),
    ]
    inputs = [tensor("observation", "float32", 1)]
    outputs = [tensor("action", "int64"), tensor("action_dist_inputs", "float32", 2)]
    return serialized(nodes, inputs, outputs, {"zero": np.float32(0), "limit": np.float32(2)})


def continuous() -> bytes:
    """A graph whose action is a vector: it copies its observation."""
    nodes = [
        helper.make_node("Identity", ["observation"], ["action"]),
        helper.make_node("Concat", ["observation", "observation"], ["action_dist_inputs"], axis=1),
    ]
    outputs = [tensor("action", "float32", 2), tensor("action_dist_inputs", "float32", 4)]
    return serialized(nodes, [tensor("observation", "float32", 2)], outputs, {})


def serialized(
    nodes: list[onnx.NodeProto],
    inputs: list[ValueInfoProto],
    outputs: list[ValueInfoProto],
    constants: Mapping[str, np.ndarray | np.generic],
) -> bytes:
    """A graph in the format of exported ones."""
    initializers = [numpy_helper.from_array(np.asarray(value), name) for name, value in constants.items()]
    graph = helper.make_graph(nodes, "policy", inputs, outputs, initializers)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    onnx.checker.check_model(model)
    return model.SerializeToString()
