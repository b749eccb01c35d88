"""Probes come back as they went, and a graph that answers otherwise is told from one that does not."""

import io
from dataclasses import replace

import numpy as np
import pytest

from league.errors import ArtifactCorrupt
from league.policies.onnx import OnnxPolicy
from league.policies.probes import Probes
from league.spaces import Discrete
from tests.league.policies.graphs import counting, masked_mlp

SPACE = Discrete(n=7)


def probes(seed: int = 0, rows: int = 16) -> Probes:
    """What masked_mlp(seed) does on random boards."""
    random = np.random.default_rng(0)
    observations = {
        "observation": random.integers(0, 2, (rows, 6, 7, 2), dtype=np.int8),
        "action_mask": np.ones((rows, 7), np.int8),
    }
    return Probes(observations, {}, OnnxPolicy(masked_mlp(seed=seed)).act(observations).actions)


def test_they_come_back_as_they_went() -> None:
    before = probes()
    after = Probes.from_bytes(before.to_bytes(), "probes")
    assert after.observations.keys() == before.observations.keys()
    for name, array in before.observations.items():
        np.testing.assert_array_equal(after.observations[name], array)
        assert after.observations[name].dtype == array.dtype
    np.testing.assert_array_equal(after.actions, before.actions)
    assert after.state == {}


def test_the_graph_that_they_were_recorded_of_answers_them() -> None:
    probes().check(OnnxPolicy(masked_mlp(seed=0)), SPACE, "probes")


def test_another_graph_is_told() -> None:
    with pytest.raises(ArtifactCorrupt, match=r"\d+ of 16 probe observations of board@1"):
        probes().check(OnnxPolicy(masked_mlp(seed=1)), SPACE, "board@1")


def test_state_is_probed_too() -> None:
    policy = OnnxPolicy(counting())
    observations = {"observation": np.array([[1], [1]], np.float32)}
    state = {"state_in_0": np.array([[0], [5]], np.float32)}
    recorded = Probes(observations, state, policy.act(observations, state=state).actions)
    again = Probes.from_bytes(recorded.to_bytes(), "probes")
    assert again.state.keys() == {"state_in_0"}
    again.check(policy, Discrete(n=2), "probes")
    with pytest.raises(ArtifactCorrupt, match="1 of 2"):
        replace(again, state={"state_in_0": np.zeros((2, 1), np.float32)}).check(policy, Discrete(n=2), "probes")


def test_probes_that_do_not_fit_the_graph_are_told() -> None:
    wrong = replace(probes(), observations={"observation": np.zeros((16, 3), np.int8)})
    with pytest.raises(ArtifactCorrupt, match="does not fit the graph"):
        wrong.check(OnnxPolicy(masked_mlp()), SPACE, "probes")
    shaped = replace(probes(), actions=np.zeros((16, 2), np.int64))
    with pytest.raises(ArtifactCorrupt, match="actions"):
        shaped.check(OnnxPolicy(masked_mlp()), SPACE, "probes")


def archive(**arrays: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


class Trap:
    """What a pickle would run."""

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
        archive(observation=np.array([Trap()], dtype=object), action=np.zeros(1)),
    ],
    ids=["empty", "no archive", "cut", "no actions", "lengths", "no rows", "a number", "pickle"],
)
def test_what_is_no_probes_is_refused(content: bytes) -> None:
    with pytest.raises(ArtifactCorrupt, match="the file holds no probes"):
        Probes.from_bytes(content, "the file")
