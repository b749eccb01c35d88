from hypothesis import given
from hypothesis import strategies as st

from league.seeds import derive, generator

seeds = st.integers(0, 2**63 - 1)
paths = st.lists(st.integers(0, 2**31) | st.text(max_size=8), min_size=1, max_size=4)


@given(seeds, paths)
def test_a_seed_and_a_path_determine_a_seed(seed: int, path: list[int | str]) -> None:
    assert derive(seed, *path) == derive(seed, *path)
    assert 0 <= derive(seed, *path) < 2**63


def test_adjacent_seeds_and_paths_differ() -> None:
    children = {derive(seed, position) for seed in range(30) for position in range(30)}
    assert len(children) == 900
    assert generator(1, 2).integers(2**60) != generator(2, 1).integers(2**60)


def test_known_values_are_stable_for_old_ledgers() -> None:
    assert derive(0, 0) == 4334430513956379144
    assert derive(42, "game", 3) == 1465044601826300333
