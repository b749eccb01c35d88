from hypothesis import given, settings
from hypothesis import strategies as st

from training.sampling.reset_seeds import SEEDS, ResetSeeds

sizes = st.integers(1, 5)


def used(seed: int, runners: int, copies: int, episodes: int, steps: int = 0) -> list[int]:
    """The seeds of one life in which each copy begins `episodes` episodes."""
    return [
        ResetSeeds.of_run(seed, runner=runner, runners=runners, copies=copies, steps=steps)(copy, episode)
        for runner in range(runners)
        for copy in range(copies)
        for episode in range(episodes)
    ]


@given(st.integers(0, 2**40), sizes, sizes, st.integers(1, 20))
@settings(deadline=None)
def test_no_two_resets_share_a_seed(seed: int, runners: int, copies: int, episodes: int) -> None:
    seeds = used(seed, runners, copies, episodes)
    assert len(set(seeds)) == len(seeds)
    assert all(0 <= number < SEEDS for number in seeds)


@given(sizes, sizes, st.integers(0, 1000), st.lists(st.lists(sizes, min_size=1, max_size=8), min_size=2, max_size=5))
@settings(deadline=None)
def test_what_begins_anew_uses_none_of_the_seeds_before(
    runners: int, copies: int, steps: int, lives: list[list[int]]
) -> None:
    """A life is a list of samples: so many actions of each copy at least. Every copy of every runner may have used as
    many seeds as it can: one at the beginning, and one after each step, in the sample that ends a step late."""
    before: set[int] = set()
    for life in lives:
        turns = sum(share + 1 for share in life)
        new = used(3, runners, copies, turns + 1, steps)
        assert not before & set(new)
        before |= set(new)
        # What all runners count: at least the share of each.
        steps += sum(share * copies * runners for share in life)


def test_beginning_anew_at_the_same_step_is_the_same_again() -> None:
    assert used(1, 2, 3, 4, steps=77) == used(1, 2, 3, 4, steps=77)


def test_runs_with_other_seeds_begin_elsewhere() -> None:
    first, second = (ResetSeeds.of_run(seed, runner=0, runners=1, copies=1, steps=0)(0, 0) for seed in (0, 1))
    assert abs(first - second) > 1000
