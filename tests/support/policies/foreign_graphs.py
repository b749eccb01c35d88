"""ONNX graphs as other programs write them: other names, types, shapes and kinds of output."""

from collections.abc import Sequence

import numpy as np
from onnx import NodeProto, TensorProto, helper, numpy_helper


def foreign(
    size: int, outputs: int, *, shape: Sequence[int] | None = None, kind: str = "logits", opset: int = 13, seed: int = 0
) -> bytes:
    """A linear map from `planes` (float32, any shape of `size`) to `policy_head`, without a mask.

    kind: logits, gaussian or action, which is then the arg max.
    """
    rng = np.random.default_rng(seed)
    weights = {"w": rng.normal(size=(size, outputs)).astype(np.float32), "flat": np.array([-1, size], np.int64)}
    nodes = [
        helper.make_node("Reshape", ["planes", "flat"], ["columns"]),
        helper.make_node("MatMul", ["columns", "w"], ["policy_head" if kind != "action" else "scores"]),
    ]
    result = helper.make_tensor_value_info("policy_head", TensorProto.FLOAT, ["N", outputs])
    if kind == "action":
        nodes.append(helper.make_node("ArgMax", ["scores"], ["policy_head"], axis=1, keepdims=0))
        result = helper.make_tensor_value_info("policy_head", TensorProto.INT64, ["N"])
    value_infos = helper.make_tensor_value_info("planes", TensorProto.FLOAT, ["N", *(shape or (size,))])
    return _model(nodes, [value_infos], [result], weights, opset)


def remembering(size: int, outputs: int) -> bytes:
    """A recurrent graph: `hidden_out` is a decaying sum of the observations, from which `policy_head` is computed."""
    rng = np.random.default_rng(0)
    weights = {"w": rng.normal(size=(size, outputs)).astype(np.float32), "decay": np.float32(0.7)}
    nodes = [
        helper.make_node("Mul", ["hidden_in", "decay"], ["faded"]),
        helper.make_node("Add", ["planes", "faded"], ["hidden_out"]),
        helper.make_node("MatMul", ["hidden_out", "w"], ["policy_head"]),
    ]
    value_infos = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, ["N", size]) for name in ("planes", "hidden_in")
    ]
    results = [
        helper.make_tensor_value_info("policy_head", TensorProto.FLOAT, ["N", outputs]),
        helper.make_tensor_value_info("hidden_out", TensorProto.FLOAT, ["N", size]),
    ]
    return _model(nodes, value_infos, results, weights, 18)


def _model(
    nodes: list[NodeProto], value_infos: list, results: list, weights: dict[str, np.ndarray], opset: int
) -> bytes:
    tensors = [numpy_helper.from_array(np.asarray(value), name) for name, value in weights.items()]
    graph = helper.make_graph(nodes, "foreign", value_infos, results, tensors)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", opset)], ir_version=8)
    return bytes(model.SerializeToString())
