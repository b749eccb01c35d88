import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from training.replay_buffer import SumTree

VALUES = st.lists(st.floats(0, 1e6).filter(lambda v: v == 0 or v > 1e-6), min_size=1, max_size=40)


@given(values=VALUES, rounds=st.integers(1, 3))
def test_a_leaf_is_found_by_its_cumulative_sum(values: list[float], rounds: int) -> None:
    tree = SumTree(len(values))
    for _ in range(rounds):
        tree.set(np.arange(len(values)), np.array(values))
    assert np.isclose(tree.total, sum(values))
    np.testing.assert_array_equal(tree.get(np.arange(len(values))), values)
    ends = np.cumsum(values)
    worth = [i for i, value in enumerate(values) if value > 1e-9 * ends[-1]]
    if worth:
        middles = np.array([ends[i] - values[i] / 2 for i in worth])
        np.testing.assert_array_equal(tree.find(middles), worth)


def test_a_leaf_with_priority_zero_is_never_found() -> None:
    tree = SumTree(5)
    tree.set(np.array([1, 3]), np.array([2.0, 6.0]))
    found = tree.find(np.linspace(0, tree.total, 1000, endpoint=True))
    assert (found[:250] == 1).all()
    assert (found[250:] == 3).all(), "rounding at the end of the range"


def test_the_last_of_duplicate_leaves_counts() -> None:
    tree = SumTree(4)
    tree.set(np.array([2, 2]), np.array([5.0, 1.0]))
    assert tree.total == pytest.approx(1.0)
