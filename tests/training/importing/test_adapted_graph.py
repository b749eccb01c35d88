"""Adapted graphs act as their sources do, for all action spaces and kinds of output."""

from contextlib import nullcontext
from typing import Any

import numpy as np
import onnx
import pytest

from league.errors import EnvironmentMismatch
from league.interface import AgentInterface
from league.policies.graph_runs import open_session
from league.policies.onnx import OnnxPolicy
from league.spaces import Box, DictSpace, Discrete, MultiDiscrete, Space
from tests.support.policies.foreign_graphs import foreign, recurrent, remembering
from training.importing.adapted_graph import adapt, graph_tensors
from training.importing.graph_mapping import GraphMapping, InputMapping, inferred
from training.importing.source import OnnxOriginal, checked

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
VECTORS = AgentInterface(observation=Box(dtype="float32", shape=(6,), low=-9, high=9), action=DISCRETE)


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
    names = inferred(model, VECTORS, "test")
    assert names.state == {"hidden_in": "hidden_out"}
    policy = OnnxPolicy(adapt(model, names, VECTORS, "test"))
    original = OnnxOriginal(model, names, VECTORS, "test")
    state, ours = original.initial_state(ROWS), None
    for seed in range(4):
        observations = {"observation": np.random.default_rng(seed).normal(size=(ROWS, 6)).astype(np.float32)}
        expected, _, state = original.act(observations, state)
        actions = policy.act(observations, state=ours)
        ours = actions.state
        assert actions.actions.tolist() == expected.tolist()
        assert ours is not None
        np.testing.assert_allclose(ours["state_in_0"], state["hidden_in"], rtol=1e-6)


@pytest.mark.parametrize(
    ("operator", "layers", "directions"), [("GRU", 1, 1), ("GRU", 3, 1), ("LSTM", 1, 2), ("LSTM", 2, 2)]
)
def test_states_with_the_layers_first_are_transposed(operator: str, layers: int, directions: int) -> None:
    """The graph of a version takes the batch first, and computes what the source does, in an episode."""
    content = recurrent(6, 5, operator=operator, layers=layers, directions=directions)
    model = onnx.load_from_string(content)
    names = inferred(model, VECTORS, "test")
    model = checked(model, names, VECTORS, "test")
    policy = OnnxPolicy(adapt(model, names, VECTORS, "test"))
    _, _, described = graph_tensors(model, names, VECTORS)
    assert {tensor.name: tensor.shape for tensor in described} == {
        f"state_in_{number}": (None, layers * directions, 4) for number in range(1 + (operator == "LSTM"))
    }
    source, original = open_session(content), OnnxOriginal(model, names, VECTORS, "test")
    rng, rows, state = np.random.default_rng(0), 7, None
    expected_state = {name: np.zeros((layers * directions, rows, 4), np.float32) for name in names.state}
    original_state = original.initial_state(rows)
    for _ in range(5):
        observations = {"observation": rng.normal(size=(rows, 6)).astype(np.float32)}
        answer = policy.distribution(observations, state=state)
        state = answer.state
        logits, *after = source.run(
            ["policy_head", *names.state.values()], {"planes": observations["observation"]} | expected_state
        )
        expected_state = dict(zip(names.state, after, strict=True))
        _, original_logits, original_state = original.act(observations, original_state)
        assert answer.dist_inputs is not None
        assert state is not None
        np.testing.assert_allclose(answer.dist_inputs, logits, atol=1e-6)
        np.testing.assert_allclose(original_logits, logits, atol=1e-6)
        for ours, theirs, array in zip(state.values(), original_state.values(), after, strict=True):
            np.testing.assert_allclose(ours, array.transpose(1, 0, 2), atol=1e-6)
            np.testing.assert_allclose(theirs, array.transpose(1, 0, 2), atol=1e-6)


def test_the_batch_of_a_state_is_its_dynamic_axis(subtests: pytest.Subtests) -> None:
    for name, sizes, message in (
        ("h_in", [1, 1, 4], r"state h_in has the fixed shape \[1, 1, 4\]: .* as axis 1 of \(layers, batch, width\)"),
        ("h_in", ["layers", "N", 4], r"state h_in has the dynamic axes \[0, 1\]: expected one, the batch"),
        ("h_out", ["N", 1, 4], r"output h_out has shape \[batch, 1, 4\], but its state h_in has \[1, batch, 4\]"),
        ("h_out", [1, "N", 5], r"output h_out has shape \[1, batch, 5\], but"),
        ("h_out", ["N", 4], r"output h_out has shape \[batch, 4\], but"),
        ("h_out", [1, 3, 4], None),
        ("h_out", ["a", "b", "c"], None),
    ):
        model = onnx.load_from_string(recurrent(6, 5))
        (info,) = [info for info in (*model.graph.input, *model.graph.output) if info.name == name]
        info.CopyFrom(onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, sizes))
        expected = nullcontext() if message is None else pytest.raises(EnvironmentMismatch, match=f"^test: {message}")
        with subtests.test(name=name, sizes=sizes), expected:
            adapt(model, inferred(model, VECTORS, "test"), VECTORS, "test")


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
        ({"state": {"h": "policy_head"}}, "state.h: the graph has the inputs planes"),
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
