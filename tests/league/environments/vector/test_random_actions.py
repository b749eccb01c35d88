import gymnasium
import numpy as np
import pytest

from league.environments.stepping import legal_rows
from league.environments.vector.random_actions import random_actions
from league.spaces import Space
from league.spaces.conversion import from_gymnasium


def space(of: gymnasium.Space) -> Space:
    return from_gymnasium(of)


SPACES = {
    "discrete": gymnasium.spaces.Discrete(5),
    "from 3": gymnasium.spaces.Discrete(5, start=3),
    "several choices": gymnasium.spaces.MultiDiscrete([2, 3]),
    "binary": gymnasium.spaces.MultiBinary(4),
    "box": gymnasium.spaces.Box(-1, 2, (2, 2), np.float32),
    "half a box": gymnasium.spaces.Box(np.array([0, -np.inf]), np.array([1, np.inf]), dtype=np.float64),
}


@pytest.mark.parametrize("name", SPACES)
def test_actions_are_in_the_space_and_differ(name: str) -> None:
    actions = random_actions(space(SPACES[name]), 200, None, np.random.default_rng(0))
    assert len(actions) == 200
    assert actions.dtype == SPACES[name].dtype
    assert all(SPACES[name].contains(action) for action in actions)
    assert len(np.unique(actions, axis=0)) > 3


def test_some_elements_of_a_box_are_at_its_bounds() -> None:
    actions = random_actions(space(SPACES["box"]), 200, None, np.random.default_rng(0))
    assert {-1.0, 2.0} <= set(actions.ravel().tolist())


@pytest.mark.parametrize(("name", "columns"), [("discrete", 5), ("from 3", 5), ("several choices", 5)])
def test_masked_actions_are_legal(name: str, columns: int) -> None:
    rng = np.random.default_rng(0)
    mask = (rng.random((300, columns)) < 0.4).astype(np.int8)
    mask[:, [0, 2]] = 1  # at least one choice for each element
    actions = random_actions(space(SPACES[name]), 300, mask, rng)
    assert legal_rows(actions, space(SPACES[name]), mask).all()


def test_all_legal_actions_are_equally_probable() -> None:
    mask = np.tile(np.array([0, 1, 1, 0, 1], dtype=np.int8), (30_000, 1))
    counts = np.bincount(random_actions(space(SPACES["discrete"]), 30_000, mask, np.random.default_rng(0)))
    assert counts[[0, 3]].tolist() == [0, 0]
    # Six standard deviations of a binomial distribution.
    assert (abs(counts[[1, 2, 4]] - 10_000) < 6 * np.sqrt(30_000 * 2 / 9)).all()
