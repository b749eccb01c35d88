"""The strength of a trial: the mean of its scores, and its interval."""

import math
from contextlib import closing
from pathlib import Path

import pytest
import torch

from evaluation.service.strength_process import StrengthProcess
from league.environments.building import interface
from league.registry.registry import Registry
from league.registry.training.strength import StrengthScore
from league.settings import Storage
from tests.support.leagues.training_leagues import tictactoe
from training.runs.trial import build_algorithm
from training.sweeps.strength import HIGH, LOW, STRENGTH, mean_strength, trial_strength


def test_a_single_score_keeps_its_interval() -> None:
    assert mean_strength([StrengthScore("script:random", 200, 0.8, 0.7, 0.875)]) == pytest.approx((0.8, 0.7, 0.875))


def test_the_interval_of_a_mean_is_narrower_than_those_of_its_scores() -> None:
    """Of n equal scores it is narrower by √n."""
    scores = [StrengthScore(f"tictactoe@{number}", 200, 0.6, 0.5, 0.7) for number in range(4)]
    assert mean_strength(scores) == pytest.approx((0.6, 0.55, 0.65))


def test_the_distances_to_the_bounds_add_up_in_quadrature() -> None:
    scores = [StrengthScore("a", 100, 0.5, 0.2, 0.9), StrengthScore("b", 100, 1.0, 0.6, 1.0)]
    mean, low, high = mean_strength(scores)
    assert mean == 0.75
    assert low == pytest.approx(0.75 - math.hypot(0.3, 0.4) / 2)
    assert high == pytest.approx(0.75 + 0.4 / 2)


@pytest.mark.usefixtures("ray_session")
def test_a_checkpoint_plays_and_training_continues_as_without_games(tmp_path: Path) -> None:
    config = tictactoe(train_batch_size=64, minibatch_size=32, epochs=1, strength={"games": 20})
    opponents = ["script:random", "script:one_ply"]
    algorithm = build_algorithm(config, interface(config))
    try:
        algorithm.train()
        algorithm.save_to_path(str(tmp_path / "64"))
    finally:
        algorithm.stop()
    with closing(Registry.open(Storage.at(tmp_path / "home"))) as registry:
        registry.leagues.register(config, interface(config))
        state = torch.get_rng_state()
        with closing(StrengthProcess(registry.storage)) as games:
            metrics = trial_strength(tmp_path / "64", config, interface(config), opponents, games)
        assert torch.equal(state, torch.get_rng_state())
        assert registry.versions.all("tictactoe") == []
    scores = [metrics[f"{STRENGTH}/{opponent}"] for opponent in opponents]
    assert metrics[STRENGTH] == pytest.approx(sum(scores) / 2)
    assert 0 <= metrics[LOW] < metrics[STRENGTH] < metrics[HIGH] <= 1
