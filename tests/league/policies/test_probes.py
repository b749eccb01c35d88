"""Probes survive serialization, and detect a graph with other actions; when two actions are regarded as equal."""

import io
from dataclasses import replace

import numpy as np
import pytest

from league.errors import ArtifactCorrupt
from league.policies.onnx import OnnxPolicy
from league.policies.probes import NEAR_TIE, Probes, excused, same
from league.spaces import Box, Discrete, MultiDiscrete
from tests.support.policies.graphs import counting, masked_mlp
from tests.support.policies.probes import probes

SPACE = Discrete(n=7)


def test_probes_survive_serialization() -> None:
    original = probes()
    restored = Probes.from_bytes(original.to_bytes(), "probes")
    assert restored.observations.keys() == original.observations.keys()
    for name, array in original.observations.items():
        np.testing.assert_array_equal(restored.observations[name], array)
        assert restored.observations[name].dtype == array.dtype
    np.testing.assert_array_equal(restored.actions, original.actions)
    assert restored.state == {}


def test_recurrent_state_is_probed() -> None:
    policy = OnnxPolicy(counting())
    observations = {"observation": np.array([[1], [1]], np.float32)}
    state = {"state_in_0": np.array([[0], [5]], np.float32)}
    recorded = Probes(observations, state, policy.act(observations, state=state).actions)
    restored = Probes.from_bytes(recorded.to_bytes(), "probes")
    assert restored.state.keys() == {"state_in_0"}
    restored.check(policy, Discrete(n=2), "probes")
    with pytest.raises(ArtifactCorrupt, match="1 of 2"):
        replace(restored, state={"state_in_0": np.zeros((2, 1), np.float32)}).check(policy, Discrete(n=2), "probes")


class MaliciousPickle:
    """Fails the test when it is unpickled."""

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return pytest.fail, ("a pickle was read",)


BOX = Box(dtype="float32", shape=(2,), low=-1, high=1)


def test_each_component_of_a_multidiscrete_action_counts() -> None:
    space = MultiDiscrete(nvec=[2, 2], start=[0, 0], shape=(2,))
    logits = np.array([[0, 0, 0, 1.0]] * 2)
    expected = np.array([[0, 1], [0, 1]])
    assert excused(np.array([[1, 1], [0, 0]]), expected, logits, space).tolist() == [True, False]


def test_box_actions_may_differ_by_a_fraction_of_their_range() -> None:
    expected = np.zeros((3, 2), np.float32)
    actions = np.array([[0, 1e-4], [0, 1e-3], [0, np.nan]], np.float32)
    assert same(actions, expected, BOX).tolist() == [True, False, False]
    assert same(actions, expected, BOX, tolerance=0.01).tolist() == [True, True, False]
    assert excused(actions, expected, np.zeros((3, 4)), BOX).tolist() == [True, False, False]


def test_another_graph_is_detected() -> None:
    probes().check(OnnxPolicy(masked_mlp(seed=0)), SPACE, "probes")
    with pytest.raises(ArtifactCorrupt, match=r"\d+ of 16 probe observations of board@1"):
        probes().check(OnnxPolicy(masked_mlp(seed=1)), SPACE, "board@1")
    wrong_observations = replace(probes(), observations={"observation": np.zeros((16, 3), np.int8)})
    wrong_actions = replace(probes(), actions=np.zeros((16, 2), np.int64))
    for wrong, message in ((wrong_observations, "does not fit the graph"), (wrong_actions, "actions")):
        with pytest.raises(ArtifactCorrupt, match=message):
            wrong.check(OnnxPolicy(masked_mlp()), SPACE, "probes")


def archive(**arrays: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


def test_invalid_probes_are_rejected(subtests: pytest.Subtests) -> None:
    pickle = np.array([MaliciousPickle()], dtype=object)
    for name, content in {
        "empty": b"",
        "not an archive": b"PK\x03\x04 and nothing more",
        "truncated": probes().to_bytes()[:-40],
        "no actions": archive(observation=np.zeros(2)),
        "lengths": archive(observation=np.zeros(2), action=np.zeros(3)),
        "no rows": archive(observation=np.zeros(0), action=np.zeros(0)),
        "scalar": archive(observation=np.zeros(1), action=np.float32(1)),
        "pickle": archive(observation=pickle, action=np.zeros(1)),
    }.items():
        with subtests.test(name), pytest.raises(ArtifactCorrupt, match="the file contains no probes"):
            Probes.from_bytes(content, "the file")


def test_actions_that_are_rounded_to_neighbouring_numbers_are_the_same() -> None:
    for dtype, is_same in (("float16", [True, False]), ("float32", [False, False])):
        space = Box(low=None, high=None, shape=(1,), dtype=dtype)
        expected = np.array([[3000], [3000]], dtype)
        actions = expected + np.array([[2], [8]], dtype)  # float16 has every second integer here
        assert same(actions, expected, space).tolist() == is_same


def test_a_near_tie_is_excused() -> None:
    logits = np.array([[1, 1 + NEAR_TIE / 2, 0], [1, 2, 0], [1, 2, 0]])
    actions, expected = np.array([0, 0, 1]), np.array([1, 1, 1])
    assert excused(actions, expected, logits, Discrete(n=3)).tolist() == [True, False, True]
    assert same(actions, expected, Discrete(n=3)).tolist() == [False, False, True]
