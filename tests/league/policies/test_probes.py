"""Probes survive serialization, and detect a graph with other actions."""

import io
from dataclasses import replace

import numpy as np
import pytest

from league.errors import ArtifactCorrupt
from league.policies.onnx import OnnxPolicy
from league.policies.probes import Probes, same
from league.spaces import Box, Discrete
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


def test_probes_match_the_graph_that_recorded_them() -> None:
    probes().check(OnnxPolicy(masked_mlp(seed=0)), SPACE, "probes")


def test_another_graph_is_detected() -> None:
    with pytest.raises(ArtifactCorrupt, match=r"\d+ of 16 probe observations of board@1"):
        probes().check(OnnxPolicy(masked_mlp(seed=1)), SPACE, "board@1")


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


def test_probes_that_do_not_fit_the_graph_are_rejected() -> None:
    wrong_observations = replace(probes(), observations={"observation": np.zeros((16, 3), np.int8)})
    with pytest.raises(ArtifactCorrupt, match="does not fit the graph"):
        wrong_observations.check(OnnxPolicy(masked_mlp()), SPACE, "probes")
    wrong_actions = replace(probes(), actions=np.zeros((16, 2), np.int64))
    with pytest.raises(ArtifactCorrupt, match="actions"):
        wrong_actions.check(OnnxPolicy(masked_mlp()), SPACE, "probes")


@pytest.mark.parametrize(("dtype", "is_same"), [("float16", [True, False]), ("float32", [False, False])])
def test_actions_that_are_rounded_to_neighbouring_numbers_are_the_same(dtype: str, is_same: list[bool]) -> None:
    space = Box(low=None, high=None, shape=(1,), dtype=dtype)
    expected = np.array([[3000], [3000]], dtype)
    actions = expected + np.array([[2], [8]], dtype)  # float16 has every second integer here
    assert same(actions, expected, space).tolist() == is_same


def archive(**arrays: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


class MaliciousPickle:
    """Fails the test when it is unpickled."""

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return pytest.fail, ("a pickle was read",)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"PK\x03\x04 and nothing more",
        probes().to_bytes()[:-40],
        archive(observation=np.zeros(2)),
        archive(observation=np.zeros(2), action=np.zeros(3)),
        archive(observation=np.zeros(0), action=np.zeros(0)),
        archive(observation=np.zeros(1), action=np.float32(1)),
        archive(observation=np.array([MaliciousPickle()], dtype=object), action=np.zeros(1)),
    ],
    ids=["empty", "not an archive", "truncated", "no actions", "lengths", "no rows", "scalar", "pickle"],
)
def test_invalid_probes_are_rejected(content: bytes) -> None:
    with pytest.raises(ArtifactCorrupt, match="the file contains no probes"):
        Probes.from_bytes(content, "the file")
