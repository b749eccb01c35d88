"""Greedy and sampled actions of a graph, and the errors for invalid inputs."""

from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from league.errors import ArtifactCorrupt, EnvironmentMismatch, InvalidInput, ObservationError
from league.interface import AgentInterface
from league.policies.actions import to_environment
from league.policies.draws import sample
from league.policies.onnx import OnnxPolicy
from league.registry.storage.manifest import PolicyManifest, Tensor
from league.spaces import Box, Discrete
from tests.support.leagues.manifests import policy_manifest
from tests.support.leagues.served_leagues import BOARD
from tests.support.policies.graphs import continuous, counting, masked_mlp

GRAPH = masked_mlp()


POLICY = OnnxPolicy(GRAPH)


def manifest(**changes: Any) -> PolicyManifest:
    """The manifest of `masked_mlp`."""
    return policy_manifest(BOARD, "shared", GRAPH).model_copy(update=changes)


def observations(rows: int, seed: int = 0) -> dict[str, np.ndarray]:
    random = np.random.default_rng(seed)
    mask = random.integers(0, 2, (rows, 7), dtype=np.int8)
    mask[np.arange(rows), random.integers(0, 7, rows)] = 1
    return {"observation": random.integers(0, 2, (rows, 6, 7, 2), dtype=np.int8), "action_mask": mask}


def generators(rows: int, seed: int = 0) -> list[np.random.Generator]:
    return [np.random.default_rng((seed, row)) for row in range(rows)]


def test_greedy_actions_are_the_mode_of_the_legal_actions() -> None:
    batch = observations(50)
    answer = POLICY.act(batch)
    logits = POLICY.act(batch, explore=True, rng=generators(50)).dist_inputs
    assert logits is not None
    assert answer.actions.tolist() == np.where(batch["action_mask"] == 1, logits, -np.inf).argmax(1).tolist()
    assert (answer.state, answer.dist_inputs) == (None, None)
    assert len(set(answer.actions.tolist())) > 3


def test_actions_do_not_depend_on_the_batch() -> None:
    batch = observations(20)
    together = POLICY.act(batch, explore=True, rng=generators(20)).actions
    for row in range(20):
        alone = {name: array[row : row + 1] for name, array in batch.items()}
        assert POLICY.act(alone, explore=True, rng=generators(20)[row : row + 1]).actions == together[row]


@given(arrays(np.int8, (4, 7), elements=st.integers(0, 1)), st.integers(0, 2**32))
def test_illegal_actions_are_never_chosen(mask: np.ndarray, seed: int) -> None:
    mask[:, seed % 7] = 1
    batch = observations(4, seed) | {"action_mask": mask}
    for answer in (POLICY.act(batch), POLICY.act(batch, explore=True, rng=generators(4, seed))):
        assert mask[np.arange(4), answer.actions].all()


def test_actions_without_a_distribution_are_certain() -> None:
    policy, batch = OnnxPolicy(masked_mlp(), manifest(), has_distribution=False), observations(5)
    values, greedy = POLICY.distribution(batch).dist_inputs, POLICY.act(batch).actions
    np.testing.assert_array_equal(policy.outputs(batch).dist_inputs, values)
    for answer in (policy.distribution(batch), policy.act(batch, explore=True, rng=generators(5))):
        assert answer.actions.tolist() == greedy.tolist()
        assert answer.dist_inputs is not None
        assert np.exp(answer.dist_inputs).tolist() == np.eye(7)[greedy].tolist()


def test_actions_start_at_the_start_of_their_space() -> None:
    policy = OnnxPolicy(masked_mlp(start=3), manifest(action=Discrete(n=7, start=3)))
    batch = observations(30)
    assert (policy.act(batch).actions == POLICY.act(batch).actions + 3).all()
    explored = policy.act(batch, explore=True, rng=generators(30)).actions
    assert (explored == POLICY.act(batch, explore=True, rng=generators(30)).actions + 3).all()


def test_recurrent_state_is_passed_in_and_returned() -> None:
    policy = OnnxPolicy(counting())
    state = None
    for step, (expected, actions) in enumerate([([1, 2], [0, 0]), ([2, 4], [0, 1]), ([3, 6], [1, 1])]):
        answer = policy.act({"observation": np.array([[1], [2]], np.float32)}, state=state)
        state = answer.state
        assert state is not None, step
        assert state["state_in_0"].ravel().tolist() == expected
        assert answer.actions.tolist() == actions
    explored = policy.act({"observation": np.zeros((1, 1), np.float32)}, explore=True, rng=generators(1))
    assert list(explored.state or ()) == ["state_in_0"]
    assert explored.dist_inputs is not None


def test_exploring_samples_from_the_distribution() -> None:
    """That of the vectors has the observation as means and as log standard deviations."""
    rows, board = 50, observations(50)
    space = Box(dtype="float32", shape=(2,), low=[-1.0, 0.0], high=[1.0, 10.0])
    unbounded = Box(dtype="float32", shape=(2,), low=None, high=None)
    vector = AgentInterface(observation=unbounded, action=space)
    policy = OnnxPolicy(continuous(), policy_manifest(vector, "shared", continuous()))
    vectors = {"observation": np.tile(np.array([0.2, -0.5], np.float32), (rows, 1))}
    for explored, batch, action in ((POLICY, board, Discrete(n=7)), (policy, vectors, space)):
        answer = explored.act(batch, explore=True, rng=generators(rows))
        assert answer.dist_inputs is not None
        drawn = to_environment(sample(answer.dist_inputs, action, generators(rows)), action)
        np.testing.assert_array_equal(answer.actions, drawn)
        assert len(np.unique(answer.actions, axis=0)) > 3
    assert answer.dist_inputs is not None
    assert answer.dist_inputs[0].tolist() == pytest.approx([0.2, -0.5, 0.2, -0.5])


def test_vectors_may_be_passed_alone_and_explore_only_with_a_manifest() -> None:
    policy, value = OnnxPolicy(continuous()), np.array([[0.25, -1.5]], np.float32)
    assert (policy.act({"observation": value}).actions == value).all()
    assert (policy.act(value).actions == value).all()
    with pytest.raises(EnvironmentMismatch, match="cannot explore without a manifest"):
        policy.act({"observation": value}, explore=True, rng=generators(1))


def test_an_observation_that_does_not_fit_is_rejected(subtests: pytest.Subtests) -> None:
    batch, recurrent = observations(1), {"observation": np.zeros((1, 1), np.float32)}
    misfits: list[tuple[Any, str]] = [
        (np.zeros((1, 6, 7, 2)), r"observation is float64 \[6, 7, 2\]: expected .* int8"),
        (np.zeros((1, 6, 7), np.int8), r"observation is int8 \[6, 7\]: expected .*\[6, 7, 2\]"),
        (np.zeros((2, 6, 7, 2), np.int8), "rows differ: .*'observation': 2"),
        ([[0]], "observation is not a NumPy array"),
    ]
    for observation, message in misfits:
        with subtests.test(message=message), pytest.raises(ObservationError, match=message):
            POLICY.act(batch | {"observation": observation})
    with pytest.raises(ObservationError, match=r"action_mask is missing: expected a batch of int8 \[7\]"):
        POLICY.act(batch["observation"])
    for state, message in (({"state_in_0": np.zeros((1, 2), np.float32)}, r"float32 \[2\]"), ({}, "missing")):
        with pytest.raises(ObservationError, match=f"state_in_0 is {message}"):
            OnnxPolicy(counting()).act(recurrent, state=state)
    for rng in (None, generators(1)):
        with pytest.raises(InvalidInput, match="2 rows needs rng"):
            POLICY.act(observations(2), explore=True, rng=rng)


def test_a_graph_that_contradicts_its_manifest_is_rejected(tmp_path: Path, subtests: pytest.Subtests) -> None:
    (tmp_path / "shared.onnx").write_bytes(GRAPH)
    batch, correct = observations(9), manifest()
    for graph in (tmp_path / "shared.onnx", str(tmp_path / "shared.onnx")):
        assert OnnxPolicy(graph, correct).act(batch).actions.tolist() == POLICY.act(batch).actions.tolist()
    action = Tensor(name="action", dtype="int32", shape=(None,))
    model = onnx.load_from_string(GRAPH)
    del model.graph.output[1]
    for graph, changes, message in (
        (b"no graph", {}, "ONNX Runtime cannot load the graph"),
        (GRAPH[:-100], {}, "ONNX Runtime cannot load the graph"),
        (model.SerializeToString(), {}, "has no output action_dist_inputs"),
        (GRAPH, {"inputs": correct.inputs[:1]}, "input action_mask of the graph is int8, but missing in"),
        (counting(), {}, "input action_mask of the graph is missing, but int8 in the manifest"),
        (GRAPH, {"outputs": (action, correct.outputs[1])}, "output action of the graph is int64, but int32 in the"),
        (GRAPH, {"action": Discrete(n=8)}, "of the graph has 7 values per row, but its action space requires 8"),
    ):
        with subtests.test(message=message), pytest.raises(ArtifactCorrupt, match=message) as caught:
            OnnxPolicy(graph, manifest(**changes))
        assert "\n" not in str(caught.value)
