"""Matching of a remote model's tensors with the spaces of a policy."""

from typing import Any

import pytest

from league.errors import EnvironmentMismatch, RemoteError
from league.interface import AgentInterface
from league.policies.open_inference import read_signature
from league.spaces import Box, DictSpace, Discrete

SPACES = AgentInterface(
    observation=DictSpace(
        spaces={
            "observation": Box(dtype="float32", shape=(3,), low=None, high=None),
            "action_mask": Box(dtype="int8", shape=(4,), low=0, high=1),
        }
    ),
    action=Discrete(n=4),
)


def tensor(name: str, datatype: str, *shape: int) -> dict[str, Any]:
    return {"name": name, "datatype": datatype, "shape": [-1, *shape]}


def model(inputs: list[dict[str, Any]], outputs: list[dict[str, Any]]) -> dict[str, Any]:
    return {"name": "m", "inputs": inputs, "outputs": outputs}


def test_tensors_are_matched_by_datatype_and_shape() -> None:
    signature = read_signature(
        "m", model([tensor("x", "FP32", 3), tensor("legal", "INT8", 4)], [tensor("policy_head", "FP32", 4)]), SPACES
    )
    assert signature.inputs == {"x": "observation", "legal": "action_mask"}
    assert (signature.output, signature.is_logits) == ("policy_head", True)


def test_a_finished_action_is_preferred_and_the_mask_is_optional() -> None:
    signature = read_signature(
        "m", model([tensor("x", "FP32", 3)], [tensor("logits", "FP32", 4), tensor("best", "INT32")]), SPACES
    )
    assert (signature.output, signature.is_logits, signature.requested) == ("best", False, ["best"])


def test_state_is_matched_by_name() -> None:
    inputs = [tensor("x", "FP32", 3), tensor("state_in_0", "FP32", 8)]
    signature = read_signature(
        "m", model(inputs, [tensor("action", "INT64"), tensor("state_out_0", "FP32", 8)]), SPACES
    )
    assert signature.state["state_in_0"].shape == (8,)
    assert signature.requested == ["action", "state_out_0"]


def test_models_that_do_not_fit_are_refused() -> None:
    action = [tensor("action", "INT64")]
    for inputs, outputs, message in (
        ([tensor("x", "FP32", 2)], action, "has the input x FP32"),
        ([tensor("legal", "INT8", 4)], action, "has no input for observation"),
        ([tensor("x", "FP32", 3), tensor("y", "FP32", 3)], action, "two inputs for the same"),
        ([tensor("x", "FP32", 3)], [tensor("value", "FP32", 1)], "or logits FP32"),
        ([], action, "lists no inputs"),
    ):
        with pytest.raises(EnvironmentMismatch, match=message):
            read_signature("m", model(inputs, outputs), SPACES)
    with pytest.raises(RemoteError, match="does not describe its inputs"):
        read_signature("m", {"error": "no"}, SPACES)
