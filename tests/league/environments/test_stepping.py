import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st

from league.environments.stepping import Batch, allows_nothing, check_actions
from league.errors import IllegalAction
from league.spaces import ACTION_MASK
from league.spaces.conversion import from_gymnasium

AGENTS = ("first", "second")


def check(space: spaces.Space, actions: np.ndarray, mask: np.ndarray | None = None) -> None:
    rows = 2
    observations = {} if mask is None else {ACTION_MASK: np.stack([mask] * rows)}
    batch = Batch(np.zeros(rows, int), np.arange(rows), observations, np.zeros(rows))
    check_actions(batch, actions, from_gymnasium(space), AGENTS)


@settings(deadline=None)
@given(st.integers(0, 1000))
def test_samples_of_a_space_are_legal(seed: int) -> None:
    for space in (
        spaces.Discrete(4, start=-2),
        spaces.MultiDiscrete([[2, 3], [4, 5]], start=[[1, 0], [0, 7]]),
        spaces.Box(np.array([-1, -np.inf], np.float32), np.array([np.inf, 2], np.float32)),
        spaces.Box(-1, 1, (2, 3)),
        spaces.MultiBinary(3),
    ):
        space.seed(seed)
        check(space, np.stack([space.sample(), space.sample()]))


def test_masks_apply_per_element() -> None:
    space, mask = spaces.MultiDiscrete([2, 3]), np.array([1, 0, 0, 1, 1], np.int8)
    check(space, np.array([[0, 1], [0, 2]]), mask)
    for illegal in ([1, 1], [0, 0]):
        with pytest.raises(IllegalAction, match="of second is illegal: action_mask is"):
            check(space, np.array([[0, 1], illegal]), mask)
    with pytest.raises(IllegalAction, match="of first"):
        check(spaces.Discrete(3), np.array([1, 0]), np.array([1, 0, 1]))


def test_a_mask_that_allows_no_action_is_detected() -> None:
    choices = from_gymnasium(spaces.MultiDiscrete([2, 3]))
    masks = np.array([[1, 1, 0, 0, 0], [0, 1, 0, 0, 1], [0, 0, 1, 1, 1]], np.int8)
    assert allows_nothing(masks, choices).tolist() == [True, False, True]
    one = from_gymnasium(spaces.Discrete(5))
    assert allows_nothing(np.array([[0, 0, 0, 0, 0], [0, 0, 0, 0, 1]], np.int8), one).tolist() == [True, False]


def test_an_action_outside_its_space_is_rejected_with_its_agent(subtests: pytest.Subtests) -> None:
    for space, illegal in (
        (spaces.Discrete(4, start=-2), 2),
        (spaces.Discrete(4), -1),
        (spaces.MultiDiscrete([2, 3]), [1, 3]),
        (spaces.MultiDiscrete([2, 3], start=[1, 1]), [0, 1]),
        (spaces.Box(-1, 1, (2,)), [0.0, 1.01]),
        (spaces.Box(-1, 1, (2,)), [0.0, np.nan]),
        (spaces.Box(-np.inf, np.inf, (2,)), [0.0, np.inf]),
        (spaces.MultiBinary(2), [0, 2]),
    ):
        space.seed(0)
        with subtests.test(space=str(space)), pytest.raises(IllegalAction, match=r"action .* of second is illegal"):
            check(space, np.stack([space.sample(), np.asarray(illegal)]))
    with pytest.raises(IllegalAction, match="1 actions for 2 agents"):
        check(spaces.Discrete(3), np.array([1]))
    with pytest.raises(IllegalAction, match=r"have shape \[1\], not \[2\]"):
        check(spaces.Box(-1, 1, (2,)), np.zeros((2, 1), np.float32))
