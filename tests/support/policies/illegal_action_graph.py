"""A graph that answers with illegal actions."""

from __future__ import annotations

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from tests.support.leagues import tictactoe


def illegal_action_graph(crashes: bool) -> bytes:
    """A graph that takes the centre even if it is taken. If it `crashes`, it fails instead where the centre is taken:
    it reads index 1 of a table with one element.
    """
    model = onnx.load_model_from_string(tictactoe.graph(order=tictactoe.CENTRE_FIRST))
    (masking,) = (node for node in model.graph.node if node.op_type == "Where")
    masking.CopyFrom(helper.make_node("Identity", ["wanted"], masking.output))
    if crashes:
        (choosing,) = (node for node in model.graph.node if node.op_type == "ArgMax")
        choosing.output[0] = "centre"
        constants = {"four": np.array(4), "one": np.array(1), "table": np.array([0])}
        model.graph.initializer.extend(numpy_helper.from_array(value, name) for name, value in constants.items())
        model.graph.node.extend(
            [
                helper.make_node("Gather", ["action_mask", "four"], ["is_free"], axis=1),
                helper.make_node("Cast", ["is_free"], ["free"], to=TensorProto.INT64),
                helper.make_node("Sub", ["one", "free"], ["place"]),
                helper.make_node("Gather", ["table", "place"], ["nothing"]),
                helper.make_node("Add", ["centre", "nothing"], ["action"]),
            ]
        )
    return bytes(model.SerializeToString())
