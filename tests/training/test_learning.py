"""The shipped configurations learn: shortened runs of `benchmarks.learning` with the shipped settings."""

from pathlib import Path

import pytest

from benchmarks.optimal_play import crossing_optimum
from benchmarks.training.learned import LearningCurve, learn
from league.config.league import LeagueConfig

CONFIGS = Path(__file__).parents[2] / "policy_league/configs"
# Training takes minutes on a busy machine, more than the timeout of other tests.
pytestmark = [pytest.mark.slow, pytest.mark.timeout(900), pytest.mark.usefixtures("ray_session")]


def load_config(name: str, **training: object) -> LeagueConfig:
    return LeagueConfig.load(CONFIGS / f"{name}.yaml").with_training(runners=0, seed=0, **training)


def train(name: str, steps: int, episodes: int = 64, **training: object) -> LearningCurve:
    return learn(load_config(name, **training), steps=steps, episodes=episodes)


@pytest.mark.parametrize("opponent", ["script:first", "script:mirror"])
def test_rps_learns_the_best_response_to_a_fixed_opponent(opponent: str) -> None:
    """Wins almost all of fifteen rounds."""
    assert train("rps", 150_000, opponents=[opponent]).greedy.mean() > 14


def test_cars_and_lights_approaches_the_optimum() -> None:
    learned = train("cars_and_lights", 400_000)
    best = crossing_optimum(**load_config("cars_and_lights").environment.kwargs)
    share = (learned.greedy.mean() - learned.random.mean()) / (best - learned.random.mean())
    assert share > 0.6, share


def test_simple_spread_improves_on_random_play() -> None:
    learned = train("simple_spread", 150_000)
    assert learned.greedy.mean() - learned.random.mean() > 2


def test_a_shared_encoder_learns_with_fewer_parameters() -> None:
    learned = train("shared_encoder", 150_000)
    assert learned.greedy.mean() - learned.random.mean() > 1
    assert learned.parameters < train("shared_encoder", 1, episodes=2, shared_encoder=False).parameters * 0.6


def test_pistonball_trains_with_the_shipped_settings() -> None:
    """Learning takes too long for a test: the benchmark measures it."""
    learned = train("pistonball", 320, episodes=1, train_batch_size=320, num_envs=1, epochs=1)
    assert learned.curve[-1].steps >= 320


def test_the_adversary_of_simple_adversary_learns_to_follow_the_good_side() -> None:
    """The adversary gains most by following; the deception of the good side takes longer to learn."""
    settings = {"learning_starts": 2560, "update_every": 100, "batch_size": 256}
    learned = train("simple_adversary", 120_000, episodes=200, **settings)
    adversary, random = (returns.reshape(3, -1)[0].mean() for returns in (learned.greedy, learned.random))
    assert adversary - random > 3
