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


@given(sizes, sizes, st.integers(1, 10), st.integers(1, 10), st.integers(0, 30))
@settings(deadline=None)
def test_a_life_after_an_interruption_uses_none_of_the_seeds_before(
    runners: int, copies: int, before: int, after: int, more_moves: int
) -> None:
    """Each episode took at least one move, and all copies move together."""
    steps = runners * copies * before + more_moves
    assert not set(used(3, runners, copies, before)) & set(used(3, runners, copies, after, steps=steps))


def test_one_runner_that_starts_again_does_not_meet_the_others() -> None:
    """The others go on with the numbers that they had when it began."""
    others = {
        ResetSeeds.of_run(0, runner=runner, runners=3, copies=2, steps=0)(copy, episode)
        for runner in (0, 2)
        for copy in range(2)
        for episode in range(200)
    }
    again = ResetSeeds.of_run(0, runner=1, runners=3, copies=2, steps=101)
    assert not others & {again(copy, episode) for copy in range(2) for episode in range(200)}


def test_runs_with_other_seeds_begin_elsewhere() -> None:
    first, second = (ResetSeeds.of_run(seed, runner=0, runners=1, copies=1, steps=0)(0, 0) for seed in (0, 1))
    assert abs(first - second) > 1000
