"""Greedy and sampled actions of a graph, and the errors for invalid inputs."""

from pathlib import Path
from statistics import NormalDist
from typing import Any

import numpy as np
import onnx
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from league.errors import ArtifactCorrupt, EnvironmentMismatch, InvalidInput, ObservationError
from league.policies.onnx import OnnxPolicy
from league.registry.storage.manifest import Parity, PolicyManifest, Tensor
from league.spaces import Box, DictSpace, Discrete
from tests.support.policies.graphs import continuous, counting, masked_mlp

GRAPH = masked_mlp()


POLICY = OnnxPolicy(GRAPH)


def manifest(**changes: Any) -> PolicyManifest:
    """The manifest of `masked_mlp`."""
    board = Box(dtype="int8", shape=(6, 7, 2), low=0, high=1)
    mask = Box(dtype="int8", shape=(7,), low=0, high=1)
    fields: dict[str, Any] = {
        "file": "shared.onnx",
        "observation": DictSpace(spaces={"observation": board, "action_mask": mask}),
        "action": Discrete(n=7),
        "inputs": (
            Tensor(name="observation", dtype="int8", shape=(None, 6, 7, 2)),
            Tensor(name="action_mask", dtype="int8", shape=(None, 7)),
        ),
        "outputs": (
            Tensor(name="action", dtype="int64", shape=(None,)),
            Tensor(name="action_dist_inputs", dtype="float32", shape=(None, 7)),
        ),
        "parity": Parity(observations=2000, mismatches=0, near_ties=0, max_difference=0.0),
    }
    return PolicyManifest.model_validate(fields | changes)


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


def test_exploring_follows_the_distribution() -> None:
    rows = 20_000
    batch = {name: np.repeat(array, rows, axis=0) for name, array in observations(1, seed=3).items()}
    answer = POLICY.act(batch, explore=True, rng=generators(rows))
    assert answer.dist_inputs is not None
    weights = np.exp(answer.dist_inputs[0].astype(np.float64))
    probability = weights / weights.sum()
    share = np.bincount(answer.actions, minlength=7) / rows
    assert (probability > 0.05).sum() > 2, "several actions are likely"
    assert (np.abs(share - probability) <= 5 * np.sqrt(probability * (1 - probability) / rows)).all()


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


def test_sampled_vectors_are_within_their_bounds() -> None:
    """Means and log standard deviations are both the observation, here 0.2 and -0.5."""
    rows = 4000
    space = Box(dtype="float32", shape=(2,), low=[-1.0, 0.0], high=[1.0, 10.0])
    policy = OnnxPolicy(
        continuous(),
        manifest(
            observation=Box(dtype="float32", shape=(2,), low=None, high=None),
            action=space,
            inputs=(Tensor(name="observation", dtype="float32", shape=(None, 2)),),
            outputs=(
                Tensor(name="action", dtype="float32", shape=(None, 2)),
                Tensor(name="action_dist_inputs", dtype="float32", shape=(None, 4)),
            ),
        ),
    )
    batch = {"observation": np.tile(np.array([0.2, -0.5], np.float32), (rows, 1))}
    answer = policy.act(batch, explore=True, rng=generators(rows))
    assert (answer.actions >= [-1, 0]).all()
    assert (answer.actions <= [1, 10]).all()
    assert answer.dist_inputs is not None
    assert answer.dist_inputs[0].tolist() == pytest.approx([0.2, -0.5, 0.2, -0.5])
    # A normal variable with mean μ and standard deviation σ is clipped at 1 with probability 1 − Φ((1 − μ) / σ).
    cut = [1 - NormalDist(mean, np.exp(mean)).cdf(1) for mean in (0.2, -0.5)]
    np.testing.assert_allclose((answer.actions == [1, 10]).mean(0), cut, atol=0.04)
    alone = policy.act({"observation": batch["observation"][7:8]}, explore=True, rng=generators(8)[7:])
    assert (alone.actions[0] == answer.actions[7]).all()


def test_vectors_may_be_passed_alone_and_explore_only_with_a_manifest() -> None:
    policy, value = OnnxPolicy(continuous()), np.array([[0.25, -1.5]], np.float32)
    assert (policy.act({"observation": value}).actions == value).all()
    assert (policy.act(value).actions == value).all()
    with pytest.raises(EnvironmentMismatch, match="cannot explore without a manifest"):
        policy.act({"observation": value}, explore=True, rng=generators(1))


def test_an_observation_that_does_not_fit_is_rejected(subtests: pytest.Subtests) -> None:
    batch, recurrent = observations(1), {"observation": np.zeros((1, 1), np.float32)}
    for act, message in (
        (lambda: POLICY.act(batch["observation"]), r"action_mask is missing: expected a batch of int8 \[7\]"),
        (
            lambda: POLICY.act(batch | {"observation": np.zeros((1, 6, 7, 2))}),
            r"observation is float64 \[6, 7, 2\]: expected .* int8",
        ),
        (
            lambda: POLICY.act(batch | {"observation": np.zeros((1, 6, 7), np.int8)}),
            r"observation is int8 \[6, 7\]: expected .*\[6, 7, 2\]",
        ),
        (
            lambda: POLICY.act(batch | {"observation": np.zeros((2, 6, 7, 2), np.int8)}),
            r"rows differ: .*'observation': 2",
        ),
        (lambda: POLICY.act(batch | {"observation": [[0]]}), r"observation is not a NumPy array"),
        (
            lambda: OnnxPolicy(counting()).act(recurrent, state={"state_in_0": np.zeros((1, 2), np.float32)}),
            r"state_in_0 is float32 \[2\]",
        ),
        (lambda: OnnxPolicy(counting()).act(recurrent, state={}), r"state_in_0 is missing"),
    ):
        with subtests.test(message=message), pytest.raises(ObservationError, match=message):
            act()
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
