"""ONNX graphs as other programs write them: other names, types, shapes and kinds of output."""

from collections.abc import Sequence

import numpy as np
from onnx import NodeProto, TensorProto, helper, numpy_helper


def foreign(
    size: int, outputs: int, *, shape: Sequence[int] | None = None, kind: str = "logits", opset: int = 13, seed: int = 0
) -> bytes:
    """A linear map from `planes` (float32, any shape of `size`) to `policy_head`, without a mask.

    kind: logits, gaussian, probabilities after a softmax, or action, which is then the arg max.
    """
    rng = np.random.default_rng(seed)
    weights = {"w": rng.normal(size=(size, outputs)).astype(np.float32), "flat": np.array([-1, size], np.int64)}
    nodes = [
        helper.make_node("Reshape", ["planes", "flat"], ["columns"]),
        helper.make_node("MatMul", ["columns", "w"], ["policy_head" if kind in ("logits", "gaussian") else "scores"]),
    ]
    result = helper.make_tensor_value_info("policy_head", TensorProto.FLOAT, ["N", outputs])
    if kind == "probabilities":
        nodes.append(helper.make_node("Softmax", ["scores"], ["policy_head"], axis=1))
    if kind == "action":
        nodes.append(helper.make_node("ArgMax", ["scores"], ["policy_head"], axis=1, keepdims=0))
        result = helper.make_tensor_value_info("policy_head", TensorProto.INT64, ["N"])
    value_infos = helper.make_tensor_value_info("planes", TensorProto.FLOAT, ["N", *(shape or (size,))])
    return _model(nodes, [value_infos], [result], weights, opset)


def influenced(kind: str) -> bytes:
    """A graph for 18 float32 to 9 logits whose rows influence each other, or that draws random numbers.

    kind: softmax, running_sum, normalized, ranked or unbatched, all over axis 0; or dropout.
    """
    ends = {"softmax": helper.make_node("Softmax", ["scores"], ["policy_head"], axis=0)}
    ends["running_sum"] = helper.make_node("CumSum", ["scores", "zero"], ["policy_head"])
    ends["normalized"] = helper.make_node(
        "BatchNormalization", ["scores", "ones", "zeros", "zeros", "ones"], ["policy_head", "mean", "var"],
        training_mode=1,
    )  # fmt: skip
    ends["ranked"] = helper.make_node("TopK", ["scores", "rows"], ["policy_head", "ranks"], axis=0)
    ends["unbatched"] = helper.make_node("Squeeze", ["scores"], ["policy_head"])
    ends["dropout"] = helper.make_node("Dropout", ["scores", "half", "true"], ["policy_head"])
    weights = {
        "w": np.random.default_rng(0).normal(size=(18, 9)).astype(np.float32), "flat": np.array([-1, 18], np.int64),
        "zero": np.int64(0), "half": np.float32(0.5), "true": np.bool_(True),
        "ones": np.ones(9, np.float32), "zeros": np.zeros(9, np.float32),
    }  # fmt: skip
    nodes = [
        helper.make_node("Reshape", ["planes", "flat"], ["columns"]),
        helper.make_node("MatMul", ["columns", "w"], ["scores"]),
        helper.make_node("Shape", ["scores"], ["rows"], start=0, end=1),
        ends[kind],
    ]
    planes = helper.make_tensor_value_info("planes", TensorProto.FLOAT, ["N", 3, 3, 2])
    result = helper.make_tensor_value_info("policy_head", TensorProto.FLOAT, ["N", 9])
    return _model(nodes, [planes], [result], weights, 18)


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


def recurrent(size: int, outputs: int, *, operator: str = "GRU", layers: int = 1, directions: int = 1) -> bytes:
    """A recurrent graph whose states have the order of ONNX's operators, and PyTorch's: (layers, batch, width).

    operator: GRU with `h_in`, or LSTM, which also has `c_in`. Each of the `layers` has as many states as `directions`.
    """
    rng, width = np.random.default_rng(0), 4
    gates, letters = (3, "h") if operator == "GRU" else (4, "hc")
    direction = "bidirectional" if directions == 2 else "forward"
    weights = {
        "first": np.array([0], np.int64),
        "joined": np.array([1, -1, directions * width], np.int64),
        "w": rng.normal(size=(directions * width, outputs)).astype(np.float32),
    }
    nodes = [helper.make_node("Unsqueeze", ["planes", "first"], ["below_0"])]
    for letter in letters:
        parts = [f"{letter}_in_{layer}" for layer in range(layers)]
        nodes.append(helper.make_node("Split", [f"{letter}_in"], parts, axis=0, num_outputs=layers))
    for layer in range(layers):
        features = directions * width if layer else size
        for name, columns in (("input", features), ("state", width)):
            weights[f"{name}_{layer}"] = rng.normal(size=(directions, gates * width, columns)).astype(np.float32)
        before = [f"{letter}_in_{layer}" for letter in letters]
        after = [f"{letter}_out_{layer}" for letter in letters]
        arguments = [f"below_{layer}", f"input_{layer}", f"state_{layer}", "", "", *before]
        nodes += [
            helper.make_node(operator, arguments, [f"y_{layer}", *after], hidden_size=width, direction=direction),
            helper.make_node("Transpose", [f"y_{layer}"], [f"turned_{layer}"], perm=[0, 2, 1, 3]),
            helper.make_node("Reshape", [f"turned_{layer}", "joined"], [f"below_{layer + 1}"]),
        ]
    for letter in letters:
        parts = [f"{letter}_out_{layer}" for layer in range(layers)]
        nodes.append(helper.make_node("Concat", parts, [f"{letter}_out"], axis=0))
    nodes += [
        helper.make_node("Squeeze", [f"below_{layers}", "first"], ["features"]),
        helper.make_node("MatMul", ["features", "w"], ["policy_head"]),
    ]
    order = [layers * directions, "N", width]
    infos = {"planes": ["N", size], "policy_head": ["N", outputs]}
    infos |= {f"{letter}_{way}": order for letter in letters for way in ("in", "out")}
    described = {name: helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name, shape in infos.items()}
    arguments = ["planes", *(f"{letter}_in" for letter in letters)]
    results = ["policy_head", *(f"{letter}_out" for letter in letters)]
    return _model(nodes, [described[name] for name in arguments], [described[name] for name in results], weights, 18)


def _model(
    nodes: list[NodeProto], value_infos: list, results: list, weights: dict[str, np.ndarray], opset: int
) -> bytes:
    tensors = [numpy_helper.from_array(np.asarray(value), name) for name, value in weights.items()]
    graph = helper.make_graph(nodes, "foreign", value_infos, results, tensors)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", opset)], ir_version=8)
    return bytes(model.SerializeToString())
