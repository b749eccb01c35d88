import gymnasium
import numpy as np
import pytest

from league.environments.stepping import legal_rows
from league.environments.vector.random_actions import random_actions
from league.spaces.conversion import from_gymnasium

SPACES = {
    "discrete": gymnasium.spaces.Discrete(5),
    "from 3": gymnasium.spaces.Discrete(5, start=3),
    "several choices": gymnasium.spaces.MultiDiscrete([2, 3]),
    "binary": gymnasium.spaces.MultiBinary(4),
    "box": gymnasium.spaces.Box(-1, 2, (2, 2), np.float32),
    "half a box": gymnasium.spaces.Box(np.array([0, -np.inf]), np.array([1, np.inf]), dtype=np.float64),
}


def test_all_legal_actions_are_equally_probable() -> None:
    mask = np.tile(np.array([0, 1, 1, 0, 1], dtype=np.int8), (30_000, 1))
    counts = np.bincount(random_actions(from_gymnasium(SPACES["discrete"]), 30_000, mask, np.random.default_rng(0)))
    assert counts[[0, 3]].tolist() == [0, 0]
    # Six standard deviations of a binomial distribution.
    assert (abs(counts[[1, 2, 4]] - 10_000) < 6 * np.sqrt(30_000 * 2 / 9)).all()


def test_actions_are_in_the_space_and_differ(subtests: pytest.Subtests) -> None:
    for name, space in SPACES.items():
        with subtests.test(name):
            actions = random_actions(from_gymnasium(space), 200, None, np.random.default_rng(0))
            assert len(actions) == 200
            assert actions.dtype == space.dtype
            assert all(space.contains(action) for action in actions)
            assert len(np.unique(actions, axis=0)) > 3
            assert name != "box" or {-1.0, 2.0} <= set(actions.ravel().tolist()), "some elements are at the bounds"


def test_masked_actions_are_legal() -> None:
    rng = np.random.default_rng(0)
    for name in ("discrete", "from 3", "several choices"):
        mask = (rng.random((300, 5)) < 0.4).astype(np.int8)
        mask[:, [0, 2]] = 1  # at least one choice for each element
        space = from_gymnasium(SPACES[name])
        assert legal_rows(random_actions(space, 300, mask, rng), space, mask).all()
