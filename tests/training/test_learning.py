"""The shipped configurations learn: `benchmarks.learning`, in short, with the settings that ship."""

from pathlib import Path

import pytest

from benchmarks.learned import Learned, learn
from examples import traffic
from league.config import LeagueConfig

CONFIGS = Path(__file__).parents[2] / "configs"
pytestmark = pytest.mark.usefixtures("ray_session")


def shipped(name: str, **training: object) -> LeagueConfig:
    return LeagueConfig.load(CONFIGS / f"{name}.yaml").with_training(runners=0, seed=0, **training)


def trained(name: str, steps: int, episodes: int = 64, **training: object) -> Learned:
    return learn(shipped(name, **training), steps=steps, episodes=episodes)


@pytest.mark.parametrize("opponent", ["script:first", "script:mirror"])
def test_rps_learns_the_best_response_to_a_fixed_opponent(opponent: str) -> None:
    """Every round of fifteen won."""
    assert trained("rps", 150_000, opponents=[opponent]).greedy.mean() > 14


def test_cars_and_lights_come_most_of_the_way_to_the_optimum() -> None:
    learned = trained("cars_and_lights", 400_000)
    best = traffic.optimum(**shipped("cars_and_lights").environment.kwargs)
    share = (learned.greedy.mean() - learned.random.mean()) / (best - learned.random.mean())
    assert share > 0.6, share


def test_simple_spread_is_soon_better_than_random() -> None:
    learned = trained("simple_spread", 150_000)
    assert learned.greedy.mean() - learned.random.mean() > 2


def test_policies_with_a_shared_encoder_learn_with_fewer_numbers() -> None:
    learned = trained("shared_encoder", 150_000)
    assert learned.greedy.mean() - learned.random.mean() > 1
    assert learned.parameters < trained("shared_encoder", 1, episodes=2, shared_encoder=False).parameters * 0.6


def test_pistonball_trains_by_the_settings_that_ship() -> None:
    """Whether it learns takes longer to see than a test may: that is the benchmark's."""
    learned = trained("pistonball", 320, episodes=1, train_batch_size=320, copies=1, epochs=1)
    assert learned.curve[-1].steps >= 320


def test_the_adversary_of_simple_adversary_soon_follows_the_good_side() -> None:
    """It has all to win by that; what the good side gains by deceiving it shows later."""
    settings = {"learning_starts": 2560, "update_every": 100, "batch_size": 256}
    learned = trained("simple_adversary", 120_000, episodes=200, **settings)
    adversary, random = (returns.reshape(3, -1)[0].mean() for returns in (learned.greedy, learned.random))
    assert adversary - random > 3
