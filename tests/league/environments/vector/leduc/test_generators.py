import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from rlcard.utils import seeding

from league.environments.vector.leduc import deals
from league.environments.vector.leduc.deals import Generators, outputs

SEEDS = st.lists(st.integers(0, 2**31 - 1), min_size=1, max_size=5)


@given(SEEDS, st.integers(1, 700))
@example([0, 1, 2**31 - 1], 700)
def test_outputs_equal_those_of_rlcards_generators(seeds: list[int], count: int) -> None:
    expected = [seeding.np_random(seed)[0].randint(0, 2**32, size=count, dtype=np.uint32) for seed in seeds]
    assert np.array_equal(outputs(np.array(seeds), count), expected)


@given(SEEDS, st.lists(st.integers(1, 1000), max_size=20))
def test_draws_equal_those_of_rlcards_generators(seeds: list[int], highest: list[int]) -> None:
    states = [seeding.np_random(seed)[0] for seed in seeds]
    drawing = Generators(np.array(seeds))
    for most in highest:
        assert drawing.integers(most).tolist() == [state.randint(0, most + 1) for state in states]


@pytest.mark.parametrize("num_outputs", [1, 3, 7])
def test_more_outputs_are_computed_if_draws_need_them(num_outputs: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(deals, "NUM_OUTPUTS", num_outputs)
    seeds = range(50)
    states = [seeding.np_random(seed)[0] for seed in seeds]
    drawing = Generators(np.array(seeds))
    for highest in (5, 4, 3, 2, 1, 1):
        assert drawing.integers(highest).tolist() == [state.randint(0, highest + 1) for state in states]


def test_no_seeds() -> None:
    assert Generators(np.zeros(0, np.int64)).integers(5).shape == (0,)
