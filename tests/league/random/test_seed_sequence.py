import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from league.random.pcg64 import generate_state

words = st.integers(0, 2**32 - 1)


@given(st.lists(st.integers(0, 2**63 - 1), max_size=5), st.lists(words, max_size=4))
def test_states_equal_those_of_numpy(seeds: list[int], spawn_key: list[int]) -> None:
    expected = [np.random.SeedSequence(seed, spawn_key=spawn_key).generate_state(4, np.uint64) for seed in seeds]
    found = generate_state(np.array(seeds, dtype=np.int64), spawn_key)
    assert found.dtype == np.uint64
    assert found.T.tolist() == [state.tolist() for state in expected]


@given(st.lists(st.tuples(st.integers(0, 2**63 - 1), words, words), max_size=5), words)
def test_each_seed_may_have_its_own_spawn_key(rows: list[tuple[int, int, int]], common: int) -> None:
    seeds, first, second = np.array(rows, dtype=np.int64).reshape(-1, 3).T
    expected = [
        np.random.SeedSequence(seed, spawn_key=(a, common, b)).generate_state(4, np.uint64).tolist()
        for seed, a, b in rows
    ]
    assert generate_state(seeds, [first, common, second]).T.tolist() == expected
