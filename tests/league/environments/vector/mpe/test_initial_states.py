import numpy as np
import pytest

from league.environments.vector.mpe.initial_states import goals_and_positions
from league.random import pcg64

SEEDS = np.array([0, 1, 7, 2**31 - 1])


def with_numpy(seed: int, goals: int, landmarks: int, entities: int) -> tuple[list[int], np.ndarray]:
    rng = np.random.default_rng(seed)
    return [int(rng.integers(landmarks)) for _ in range(goals)], np.array(
        [rng.uniform(-1, 1, 2) for _ in range(entities)]
    )


@pytest.mark.parametrize("rejected", [False, True])
@pytest.mark.parametrize(("goals", "landmarks"), [(1, 1), (1, 2), (1, 3), (2, 3)])
def test_draws_equal_those_of_numpy(
    goals: int, landmarks: int, rejected: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """rejected: as if NumPy drew the goals of every second seed again."""
    if rejected:
        integers = pcg64.integers

        def rejecting(halves: np.ndarray, high: int) -> tuple[np.ndarray, np.ndarray]:
            values, accepted = integers(halves, high)
            accepted[-1, ::2] = False
            values[:, ::2] = -1
            return values, accepted

        monkeypatch.setattr(pcg64, "integers", rejecting)
    found, positions = goals_and_positions(SEEDS, goals, landmarks, entities=4)
    assert positions.shape == (4, 2, len(SEEDS))
    for i, seed in enumerate(SEEDS):
        expected_goals, expected_positions = with_numpy(int(seed), goals, landmarks, 4)
        assert found[:, i].tolist() == expected_goals
        np.testing.assert_array_equal(positions[..., i], expected_positions)
