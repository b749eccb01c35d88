"""Adapted graphs act as their sources do, for all action spaces and kinds of output."""

from typing import Any

import numpy as np
import onnx
import pytest

from league.errors import EnvironmentMismatch
from league.interface import AgentInterface
from league.policies.onnx import OnnxPolicy
from league.spaces import Box, DictSpace, Discrete, MultiDiscrete, Space
from tests.support.policies.foreign_graphs import foreign, remembering
from training.importing.adapted_graph import adapt
from training.importing.graph_mapping import GraphMapping, InputMapping, inferred
from training.importing.source import OnnxOriginal

SEEN = Box(dtype="int8", shape=(2, 3), low=-9, high=9)
ROWS = 500


def masked(actions: int) -> DictSpace:
    mask = Box(dtype="int8", shape=(actions,), low=0, high=1)
    return DictSpace(spaces={"observation": SEEN, "action_mask": mask})


def batch(actions: int | None) -> dict[str, Any]:
    rng = np.random.default_rng(1)
    observations = {"observation": rng.integers(-9, 9, (ROWS, 2, 3), dtype=np.int8)}
    if actions is not None:
        masks = rng.integers(0, 2, (ROWS, actions), dtype=np.int8)
        masks[:, rng.integers(actions)] = 1
        observations["action_mask"] = masks
    return observations


DISCRETE, SHIFTED = Discrete(n=5), Discrete(n=5, start=3)
MULTI = MultiDiscrete(nvec=[2, 3], start=[0, 1], shape=(2,), dtype="int32")
BOUNDED = Box(dtype="float32", shape=(2,), low=[-3.0, 0.0], high=[5.0, 0.5])
FREE = Box(dtype="float32", shape=(2,), low=[None, 0.0], high=[None, None])


@pytest.mark.parametrize(
    ("action", "outputs", "kind", "extra"),
    [
        (DISCRETE, 5, "logits", {}),
        (SHIFTED, 5, "values", {}),
        (SHIFTED, 5, "probabilities", {}),
        (SHIFTED, 5, "action", {}),
        (MULTI, 5, "logits", {}),
        (BOUNDED, 4, "gaussian", {}),
        (BOUNDED, 4, "gaussian", {"units": "environment"}),
        (BOUNDED, 2, "action", {}),
        (FREE, 4, "gaussian", {}),
    ],
)
@pytest.mark.parametrize(("shape", "transpose"), [((6,), []), ((2, 3), []), ((3, 2), [1, 0])])
def test_greedy_actions_equal_those_of_the_source(
    action: Space, outputs: int, kind: str, extra: dict[str, Any], shape: tuple[int, ...], transpose: list[int]
) -> None:
    integer = kind == "action" and isinstance(action, Discrete)
    model = onnx.load_from_string(foreign(6, outputs, shape=shape, kind="action" if integer else "logits"))
    has_mask = kind in ("logits", "values", "probabilities")
    spaces = AgentInterface(observation=masked(5) if has_mask else SEEN, action=action)
    names = GraphMapping(
        inputs={"planes": {"name": "observation", "transpose": transpose}}, output="policy_head", kind=kind, **extra
    )
    observations = batch(5 if has_mask else None)
    if has_mask and isinstance(action, MultiDiscrete):
        observations["action_mask"][:, [0, 2]] = 1
    policy = OnnxPolicy(adapt(model, names, spaces, "test"))
    expected, _, _ = OnnxOriginal(model, names, spaces, "test").act(observations, {})
    actions = policy.distribution(observations)
    np.testing.assert_allclose(actions.actions, expected, rtol=1e-5, atol=1e-5)
    assert actions.actions.dtype == action.dtype
    assert actions.dist_inputs is not None
    assert np.isfinite(actions.dist_inputs).all()


def test_recurrent_state_is_passed_on() -> None:
    model = onnx.load_from_string(remembering(6, 5))
    spaces = AgentInterface(observation=Box(dtype="float32", shape=(6,), low=-9, high=9), action=DISCRETE)
    names = inferred(model, spaces, "test")
    assert names.state == {"hidden_in": "hidden_out"}
    policy = OnnxPolicy(adapt(model, names, spaces, "test"))
    original = OnnxOriginal(model, names, spaces, "test")
    state, ours = original.initial_state(ROWS), None
    for seed in range(4):
        observations = {"observation": np.random.default_rng(seed).normal(size=(ROWS, 6)).astype(np.float32)}
        expected, _, state = original.act(observations, state)
        actions = policy.act(observations, state=ours)
        ours = actions.state
        assert actions.actions.tolist() == expected.tolist()
        assert ours is not None
        np.testing.assert_allclose(ours["state_in_0"], state["hidden_in"], rtol=1e-6)


def test_tensors_are_matched_by_shape() -> None:
    model = onnx.load_from_string(foreign(6, 5, shape=(2, 3)))
    names = inferred(model, AgentInterface(observation=masked(5), action=DISCRETE), "test")
    assert (names.inputs, names.output, names.kind) == (
        {"planes": InputMapping(name="observation")},
        "policy_head",
        "logits",
    )


def test_a_mapping_that_does_not_fit_is_rejected(subtests: pytest.Subtests) -> None:
    model, spaces = onnx.load_from_string(foreign(6, 5)), AgentInterface(observation=masked(5), action=DISCRETE)
    fitting = {"inputs": {"planes": "observation"}, "output": "policy_head", "kind": "logits"}
    transposed = {"planes": {"name": "observation", "transpose": [0]}}
    rows: list[tuple[dict[str, Any], str]] = [
        ({"inputs": {"board": "observation"}}, "input planes of the graph is not in the mapping"),
        ({"inputs": {"planes": "pixels"}}, "inputs.planes: the league has no pixels"),
        ({"inputs": {"planes": "action_mask"}}, r"input planes has shape \[6\], but action_mask has \[5\]"),
        ({"inputs": transposed}, "inputs.planes.transpose: observation has 2 axes"),
        ({"output": "value"}, "output value: the graph has the outputs policy_head"),
        ({"kind": "gaussian"}, "kind: gaussian does not fit discrete actions"),
        ({"state": {"h": "policy_head"}}, "state.h: expected an input"),
    ]
    for changed, message in rows:
        mapping = GraphMapping(**fitting | changed)
        with subtests.test(message), pytest.raises(EnvironmentMismatch, match=f"model.onnx: {message}"):
            adapt(model, mapping, spaces, "model.onnx")


def test_what_cannot_be_matched_is_named() -> None:
    model = onnx.load_from_string(foreign(8, 5))
    with pytest.raises(EnvironmentMismatch, match=r"input planes is float32 \[8\]: .*use a mapping file"):
        inferred(model, AgentInterface(observation=masked(5), action=DISCRETE), "test")
    model = onnx.load_from_string(foreign(6, 7, shape=(2, 3)))
    with pytest.raises(EnvironmentMismatch, match=r"outputs are policy_head float32 \[7\]"):
        inferred(model, AgentInterface(observation=masked(5), action=DISCRETE), "test")


def test_a_fixed_batch_size_is_refused() -> None:
    spaces = AgentInterface(observation=masked(5), action=DISCRETE)
    for size in (1, 32):
        model = onnx.load_from_string(foreign(6, 5, shape=(2, 3)))
        model.graph.input[0].type.tensor_type.shape.dim[0].dim_value = size
        with pytest.raises(EnvironmentMismatch, match=rf"^model.onnx: input planes has a fixed batch size of {size}: "):
            adapt(model, inferred(model, spaces, "model.onnx"), spaces, "model.onnx")
