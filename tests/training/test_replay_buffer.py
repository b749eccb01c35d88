"""The buffer, compared with a list of all rows; n-step returns by hand."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from league.config.off_policy import PrioritiesConfig
from training.replay_buffer import DISCOUNTS, ReplayBuffer, SumTree, TransitionBlock

GAMMA = 0.5


def block(numbers: list[int], streams: list[int], firsts: list[bool], **columns: NDArray) -> TransitionBlock:
    """Rows that identify themselves: observation i, reward i, next observation i + 0.5."""
    i = np.array(numbers, dtype=np.float64)
    rows = {
        "observations/x": i[:, np.newaxis],
        "rewards": i.astype(np.float32),
        "terminated": np.zeros(len(i), dtype=bool),
        "truncated": np.zeros(len(i), dtype=bool),
        "next_observations/x": i[:, np.newaxis] + 0.5,
    }
    return TransitionBlock(rows | columns, np.array(streams), np.array(firsts))


def flags(*values: int) -> NDArray:
    return np.array(values, dtype=bool)


def returns_of(replay: ReplayBuffer, index: int, n_step: int) -> tuple[float, float, float]:
    """(sum of rewards, discount, next observation) of the return that starts at a row."""
    rows = replay.rows(np.array([index]), n_step=n_step, gamma=GAMMA)
    return float(rows["rewards"][0]), float(rows[DISCOUNTS][0]), float(rows["next_observations/x"][0, 0])


def test_returns_by_hand() -> None:
    """Two interleaved streams: one continues, the other is truncated after two steps and starts a new episode."""
    replay = ReplayBuffer(16)
    replay.add(block([1, 10, 2, 20], [0, 1, 0, 1], [True] * 2 + [False] * 2, truncated=flags(0, 0, 0, 1)))
    replay.add(block([3, 30], [0, 1], [False, True], terminated=flags(0, 1)))
    # Stream 0: 1 + 2/2 + 3/4, then γ³ times the value after row 3.
    assert returns_of(replay, 0, 3) == (2.75, 0.125, 3.5)
    assert returns_of(replay, 0, 2) == (2.0, 0.25, 2.5)
    assert returns_of(replay, 0, 1) == (1.0, 0.5, 1.5)
    # A return without further rows ends early, with a bootstrap from its last observation.
    assert returns_of(replay, 2, 3) == (3.5, 0.25, 3.5)
    # Stream 1: 10 + 20/2, then γ² times the value of the truncated episode's last observation, never that of the next
    # episode.
    assert returns_of(replay, 1, 3) == (20.0, 0.25, 20.5)
    rows = replay.rows(np.array([1, 5]), n_step=3, gamma=GAMMA)
    assert (rows["terminated"].tolist(), rows["truncated"].tolist()) == ([False, True], [True, False])


def test_a_joint_return_ends_with_the_first_agent_that_leaves() -> None:
    columns = {
        "rewards": np.array([[1, 10], [2, 20], [3, 30]], np.float32),
        "terminated": np.array([[0, 0], [0, 1], [0, 0]], dtype=bool),
        "truncated": np.zeros((3, 2), dtype=bool),
    }
    replay = ReplayBuffer(8)
    replay.add(block([0, 1, 2], [7, 7, 7], [True, False, False], **columns))
    rows = replay.rows(np.array([0]), n_step=3, gamma=GAMMA)
    assert rows["rewards"][0].tolist() == pytest.approx([2.0, 20.0])
    assert rows["terminated"].tolist() == [[False, True]]
    assert rows[DISCOUNTS].tolist() == pytest.approx([0.25])


@given(
    capacity=st.integers(1, 12),
    sizes=st.lists(st.integers(1, 5), min_size=1, max_size=10),
    prioritised=st.booleans(),
    seed=st.integers(0, 99),
)
def test_samples_are_from_the_latest_rows(capacity: int, sizes: list[int], prioritised: bool, seed: int) -> None:
    replay = ReplayBuffer(capacity, priorities=PrioritiesConfig() if prioritised else None)
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
            assert last == first + steps - 1, "after wrapping around, a row has the wrong successor"
            assert reward == sum(GAMMA**k * (first + k) for k in range(steps))
            assert discount == GAMMA**steps


def test_rows_are_drawn_by_priority_with_importance_weights() -> None:
    """P(i) = p_i^α / Σ p^α, w_i = (N P(i))^−β / max w."""
    replay = ReplayBuffer(4, priorities=PrioritiesConfig(alpha=0.5))
    replay.add(block([0, 1, 2], [0, 1, 2], [True] * 3))
    replay.prioritize(np.arange(3), np.array([0.25, 1.0, 4.0]) - 1e-3)
    sample = replay.sample(70_000, beta=0.7)
    counts = np.bincount(sample.indices, minlength=4)
    p = np.array([0.5, 1.0, 2.0]) / 3.5
    np.testing.assert_allclose(counts / 70_000, [*p, 0.0], atol=1e-4)
    weights = (3 * p) ** -0.7
    np.testing.assert_allclose(sample.weights, (weights / weights.max())[sample.indices], rtol=1e-5)


@pytest.mark.parametrize("priorities", [None, PrioritiesConfig()])
def test_several_draws_at_once_equal_consecutive_ones(priorities: PrioritiesConfig | None) -> None:
    at_once, alone = (ReplayBuffer(64, priorities=priorities, seed=1) for _ in range(2))
    for replay in (at_once, alone):
        replay.add(block(list(range(50)), [0] * 50, [True] + [False] * 49))
        replay.prioritize(np.arange(50), np.arange(50.0))
    drawn = at_once.sample(7, draws=3, n_step=2, gamma=GAMMA, beta=0.5)
    singly = [alone.sample(7, n_step=2, gamma=GAMMA, beta=0.5) for _ in range(3)]
    assert drawn.indices.tolist() == [index for sample in singly for index in sample.indices]
    assert drawn.weights.tolist() == [weight for sample in singly for weight in sample.weights]
    for name, column in drawn.rows.items():
        np.testing.assert_array_equal(column, np.concatenate([sample.rows[name] for sample in singly]))


def test_new_rows_have_the_largest_priority() -> None:
    replay = ReplayBuffer(8, priorities=PrioritiesConfig(alpha=1.0))
    replay.add(block([0, 1], [0, 1], [True] * 2))
    replay.prioritize(np.array([0]), np.array([9.0]))
    replay.add(block([2], [2], [True]))
    counts = np.bincount(replay.sample(19_000).indices, minlength=3)
    np.testing.assert_allclose(counts / 1000, [9, 1, 9], atol=0.1)


@pytest.mark.parametrize("priorities", [None, PrioritiesConfig()])
def test_a_restored_buffer_continues_identically(tmp_path: Path, priorities: PrioritiesConfig | None) -> None:
    """Samples, successors, the next position, and priorities."""

    def run(replay: ReplayBuffer) -> list[NDArray]:
        replay.reseed(3, 100)
        drawn = []
        for number in range(4):
            replay.add(block([100 + number, 200 + number], [0, 1], [False, number == 2]))
            sample = replay.sample(16, n_step=2, gamma=GAMMA)
            replay.prioritize(sample.indices, sample.rows["rewards"])
            drawn += [sample.indices, sample.weights, *sample.rows.values()]
        return drawn

    replay = ReplayBuffer(7, priorities=priorities)
    for number in range(5):
        replay.add(block([number, 10 + number], [0, 1], [number == 0, False]))
    replay.prioritize(np.arange(3), np.array([1.0, 5.0, 2.0]))
    replay.save(tmp_path / "kept")
    restored = ReplayBuffer(7, priorities=priorities)
    restored.load(tmp_path / "kept")
    for before, after in zip(run(replay), run(restored), strict=True):
        np.testing.assert_array_equal(before, after)


def sequences(replay: ReplayBuffer, size: int, length: int) -> list[list[int]]:
    """The observations of each drawn sequence, without padding."""
    sample = replay.sample_sequences(size, length)
    numbers = sample.rows["observations/x"][:, 0].reshape(size, length).astype(int)
    weights = sample.weights.reshape(size, length)
    assert set(np.unique(weights)) <= {0.0, 1.0}
    assert (np.diff(weights) <= 0).all(), "padding is at the end"
    return [row[: int(count)].tolist() for row, count in zip(numbers, weights.sum(axis=1), strict=True)]


def test_sequences_start_with_an_episode() -> None:
    """Stream 0: an episode of five rows and an unfinished one; stream 1: an episode of two."""
    replay = ReplayBuffer(32)
    replay.add(block([0, 100, 1, 101, 2, 3], [0, 1, 0, 1, 0, 0], [True, True, False, False, False, False]))
    replay.add(block([4, 10, 11], [0, 0, 0], [False, True, False]))
    assert {tuple(rows) for rows in sequences(replay, 200, 9)} == {(0, 1, 2, 3, 4), (10, 11), (100, 101)}
    assert {tuple(rows) for rows in sequences(replay, 200, 3)} == {(0, 1, 2), (3, 4), (10, 11), (100, 101)}


@given(
    capacity=st.integers(4, 20), lengths=st.lists(st.integers(1, 9), min_size=1, max_size=12), seed=st.integers(0, 99)
)
def test_sequences_are_valid_after_overwriting(capacity: int, lengths: list[int], seed: int) -> None:
    """Episode e has rows 100 e, 100 e + 1, …; two streams alternate."""
    replay = ReplayBuffer(capacity)
    replay.reseed(seed, 0)
    for episode, length in enumerate(lengths):
        for row in range(length):
            replay.add(block([100 * episode + row], [episode % 2], [row == 0]))
    for rows in sequences(replay, 30, 4):
        assert rows == list(range(rows[0], rows[0] + len(rows)))
        episode, begin = divmod(rows[0], 100)
        assert begin + sum(lengths[:episode]) >= sum(lengths) - capacity, "it is overwritten"
        assert begin % 4 == 0 or capacity < 4 * max(lengths), "a sequence starts within an episode"
        assert len(rows) == min(4, lengths[episode] - begin)


def test_a_restored_buffer_gives_the_same_sequences(tmp_path: Path) -> None:
    replay = ReplayBuffer(7)
    replay.add(block([0, 1, 2, 3, 4], [0] * 5, [True, False, False, False, False]))
    replay.save(tmp_path / "kept")
    restored = ReplayBuffer(7)
    restored.load(tmp_path / "kept")
    for continued in (replay, restored):
        continued.reseed(3, 100)
        continued.add(block([5, 6], [0, 0], [False, False]))
    assert sequences(replay, 20, 3) == sequences(restored, 20, 3)


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
    leaves = tree.find(np.linspace(0, tree.total, 1000, endpoint=True))
    assert leaves.tolist() == [1] * 250 + [3] * 750, "also with rounding at the end of the range"


def test_the_last_of_duplicate_leaves_counts() -> None:
    tree = SumTree(4)
    tree.set(np.array([2, 2]), np.array([5.0, 1.0]))
    assert tree.total == pytest.approx(1.0)
