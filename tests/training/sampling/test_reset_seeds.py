from hypothesis import given, settings
from hypothesis import strategies as st

from training.sampling.reset_seeds import SEEDS, ResetSeeds

sizes = st.integers(1, 5)


def seeds_of_attempt(seed: int, runners: int, num_envs: int, episodes: int, steps: int = 0) -> list[int]:
    """The seeds of one attempt in which each environment starts `episodes` episodes."""
    return [
        ResetSeeds.of_run(seed, runner=runner, runners=runners, num_envs=num_envs, steps=steps)(env, episode)
        for runner in range(runners)
        for env in range(num_envs)
        for episode in range(episodes)
    ]


@given(st.integers(0, 2**40), sizes, sizes, st.integers(1, 20))
@settings(deadline=None)
def test_no_two_resets_share_a_seed(seed: int, runners: int, num_envs: int, episodes: int) -> None:
    seeds = seeds_of_attempt(seed, runners, num_envs, episodes)
    assert len(set(seeds)) == len(seeds)
    assert all(0 <= number < SEEDS for number in seeds)


@given(sizes, sizes, st.integers(0, 1000), st.lists(st.lists(sizes, min_size=1, max_size=8), min_size=2, max_size=5))
@settings(deadline=None)
def test_a_restart_uses_no_seed_of_earlier_attempts(
    runners: int, num_envs: int, steps: int, attempts: list[list[int]]
) -> None:
    """An attempt is a list of samples: the minimum number of actions in each environment. Each environment of each
    runner may have used the maximum number of seeds: one at the start, and one after each step, in the sample that ends
    a step late.
    """
    used_seeds: set[int] = set()
    for samples in attempts:
        turns = sum(share + 1 for share in samples)
        new = seeds_of_attempt(3, runners, num_envs, turns + 1, steps)
        assert not used_seeds & set(new)
        used_seeds |= set(new)
        # All runners together count at least the share of each.
        steps += sum(share * num_envs * runners for share in samples)


def test_a_restart_at_the_same_step_has_the_same_seeds() -> None:
    assert seeds_of_attempt(1, 2, 3, 4, steps=77) == seeds_of_attempt(1, 2, 3, 4, steps=77)


def test_runs_with_other_seeds_have_other_seeds() -> None:
    first, second = (ResetSeeds.of_run(seed, runner=0, runners=1, num_envs=1, steps=0)(0, 0) for seed in (0, 1))
    assert abs(first - second) > 1000
