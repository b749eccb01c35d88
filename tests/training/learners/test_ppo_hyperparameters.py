import pytest

from league.errors import ConfigError
from tests.support.leagues.training_leagues import tictactoe
from training.learners.ppo import Hyperparameters, hyperparameters

SETTINGS = tictactoe(gamma=0.9, per_policy={"b": {"lambda": 0.5, "lr": 0.01}}, **{"lambda": 0.8}).training


def test_a_policy_has_the_common_settings_except_its_own() -> None:
    common = {"gamma": 0.9, "clip": SETTINGS.clip, "entropy": SETTINGS.entropy}
    assert hyperparameters(SETTINGS, ("a", "b")) == {
        "a": Hyperparameters(lr=SETTINGS.lr, lambda_=0.8, **common),
        "b": Hyperparameters(lr=0.01, lambda_=0.5, **common),
    }


def test_an_unknown_policy_is_reported() -> None:
    with pytest.raises(ConfigError, match=r"training\.per_policy\.b: unknown policy; the league has a, c"):
        hyperparameters(SETTINGS, ("a", "c"))
