"""The buffer against a plain list of all that was ever added; n-step returns by hand."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from league.training_config import PrioritiesConfig
from training.replay import DISCOUNTS, Block, Replay

GAMMA = 0.5


def block(numbers: list[int], streams: list[int], firsts: list[bool], **columns: NDArray) -> Block:
    """Rows that say which they are: observation i, reward i, next observation i + 0.5."""
    i = np.array(numbers, dtype=np.float64)
    rows = {
        "observations/x": i[:, np.newaxis],
        "rewards": i.astype(np.float32),
        "terminated": np.zeros(len(i), dtype=bool),
        "truncated": np.zeros(len(i), dtype=bool),
        "next_observations/x": i[:, np.newaxis] + 0.5,
    }
    return Block(rows | columns, np.array(streams), np.array(firsts))


def flags(*values: int) -> NDArray:
    return np.array(values, dtype=bool)


def returns_of(replay: Replay, index: int, n_step: int) -> tuple[float, float, float]:
    """(sum of rewards, discount, next observation) of the return that begins at a row."""
    rows = replay.rows(np.array([index]), n_step=n_step, gamma=GAMMA)
    return float(rows["rewards"][0]), float(rows[DISCOUNTS][0]), float(rows["next_observations/x"][0, 0])


def test_returns_by_hand() -> None:
    """Two interleaved streams: one goes on, the other is truncated after two steps and begins a new episode."""
    replay = Replay(16)
    replay.add(block([1, 10, 2, 20], [0, 1, 0, 1], [True] * 2 + [False] * 2, truncated=flags(0, 0, 0, 1)))
    replay.add(block([3, 30], [0, 1], [False, True], terminated=flags(0, 1)))
    # Stream 0: 1 + 2/2 + 3/4, then γ³ times what follows 3.
    assert returns_of(replay, 0, 3) == (2.75, 0.125, 3.5)
    assert returns_of(replay, 0, 2) == (2.0, 0.25, 2.5)
    assert returns_of(replay, 0, 1) == (1.0, 0.5, 1.5)
    # What is not known yet ends a return early, by a bootstrap from its last observation.
    assert returns_of(replay, 2, 3) == (3.5, 0.25, 3.5)
    # Stream 1: 10 + 20/2, then γ² times the value of the truncated episode's last observation, never the new one's.
    assert returns_of(replay, 1, 3) == (20.0, 0.25, 20.5)
    rows = replay.rows(np.array([1, 5]), n_step=3, gamma=GAMMA)
    assert (rows["terminated"].tolist(), rows["truncated"].tolist()) == ([False, True], [True, False])


def test_a_return_does_not_run_over_truncation_even_where_rows_are_linked() -> None:
    """The check above sees it if truncation is forgotten: without the flag, the return goes on."""
    replay = Replay(4)
    replay.add(block([1, 2], [0, 0], [True, False], truncated=flags(1, 0)))
    assert returns_of(replay, 0, 2) == (1.0, 0.5, 1.5)
    forgetful = Replay(4)
    forgetful.add(block([1, 2], [0, 0], [True, False]))
    assert returns_of(forgetful, 0, 2) == (2.0, 0.25, 2.5)


def test_a_joint_return_ends_with_the_first_agent_that_leaves() -> None:
    columns = {
        "rewards": np.array([[1, 10], [2, 20], [3, 30]], np.float32),
        "terminated": np.array([[0, 0], [0, 1], [0, 0]], dtype=bool),
        "truncated": np.zeros((3, 2), dtype=bool),
    }
    replay = Replay(8)
    replay.add(block([0, 1, 2], [7, 7, 7], [True, False, False], **columns))
    rows = replay.rows(np.array([0]), n_step=3, gamma=GAMMA)
    assert rows["rewards"].tolist() == [[2.0, 20.0]]
    assert rows["terminated"].tolist() == [[False, True]]
    assert rows[DISCOUNTS].tolist() == [0.25]


@given(
    capacity=st.integers(1, 12),
    sizes=st.lists(st.integers(1, 5), min_size=1, max_size=10),
    prioritised=st.booleans(),
    seed=st.integers(0, 99),
)
@settings(deadline=None)
def test_what_is_sampled_is_among_the_newest_that_were_added(
    capacity: int, sizes: list[int], prioritised: bool, seed: int
) -> None:
    replay = Replay(capacity, priorities=PrioritiesConfig() if prioritised else None)
    replay.reseed(seed, 0)
    added = 0
    for size in sizes:
        numbers = list(range(added, added + size))
        replay.add(block(numbers, [0] * size, [i == 0 for i in numbers]))
        added += size
        newest = range(max(0, added - capacity), added)
        assert len(replay) == len(newest)
        sample = replay.sample(8, n_step=3, gamma=GAMMA)
        assert set(sample.rows["observations/x"][:, 0]) <= set(newest)
        for first, last, reward, discount in zip(
            sample.rows["observations/x"][:, 0],
            sample.rows["next_observations/x"][:, 0] - 0.5,
            sample.rows["rewards"],
            sample.rows[DISCOUNTS],
            strict=True,
        ):
            steps = min(3, added - int(first))
            assert last == first + steps - 1, "wrapped around, a row is followed by its own successor"
            assert reward == sum(GAMMA**k * (first + k) for k in range(steps))
            assert discount == GAMMA**steps


def test_rows_are_drawn_as_often_as_their_priorities_say_and_weights_make_up_for_it() -> None:
    """P(i) = p_i^α / Σ p^α, w_i = (N P(i))^−β / max w."""
    replay = Replay(4, priorities=PrioritiesConfig(alpha=0.5))
    replay.add(block([0, 1, 2], [0, 1, 2], [True] * 3))
    replay.prioritize(np.arange(3), np.array([0.25, 1.0, 4.0]) - 1e-3)
    sample = replay.sample(70_000, beta=0.7)
    counts = np.bincount(sample.indices, minlength=4)
    p = np.array([0.5, 1.0, 2.0]) / 3.5
    np.testing.assert_allclose(counts / 70_000, [*p, 0.0], atol=1e-4)
    weights = (3 * p) ** -0.7
    np.testing.assert_allclose(sample.weights, (weights / weights.max())[sample.indices], rtol=1e-5)


def test_new_rows_come_with_the_largest_priority() -> None:
    replay = Replay(8, priorities=PrioritiesConfig(alpha=1.0))
    replay.add(block([0, 1], [0, 1], [True] * 2))
    replay.prioritize(np.array([0]), np.array([9.0]))
    replay.add(block([2], [2], [True]))
    counts = np.bincount(replay.sample(19_000).indices, minlength=3)
    np.testing.assert_allclose(counts / 1000, [9, 1, 9], atol=0.1)


@pytest.mark.parametrize("priorities", [None, PrioritiesConfig()])
def test_a_saved_buffer_goes_on_as_the_one_that_saved(tmp_path: Path, priorities: PrioritiesConfig | None) -> None:
    """What is sampled, what follows what, where the next rows go, and their priorities."""

    def go_on(replay: Replay) -> list[NDArray]:
        replay.reseed(3, 100)
        found = []
        for number in range(4):
            replay.add(block([100 + number, 200 + number], [0, 1], [False, number == 2]))
            sample = replay.sample(16, n_step=2, gamma=GAMMA)
            replay.prioritize(sample.indices, sample.rows["rewards"])
            found += [sample.indices, sample.weights, *sample.rows.values()]
        return found

    replay = Replay(7, priorities=priorities)
    for number in range(5):
        replay.add(block([number, 10 + number], [0, 1], [number == 0, False]))
    replay.prioritize(np.arange(3), np.array([1.0, 5.0, 2.0]))
    replay.save(tmp_path / "kept")
    restored = Replay(7, priorities=priorities)
    restored.load(tmp_path / "kept")
    for before, after in zip(go_on(replay), go_on(restored), strict=True):
        np.testing.assert_array_equal(before, after)
