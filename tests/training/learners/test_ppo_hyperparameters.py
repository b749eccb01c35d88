from dataclasses import replace

import pytest

from league.config.schedules import ScheduleProgress
from league.errors import ConfigError
from tests.support.leagues.training_leagues import tictactoe
from training.learners.ppo import WARM_UP, Hyperparameters, hyperparameters, scheduled_hyperparameters

SETTINGS = tictactoe(gamma=0.9, per_policy={"b": {"lambda": 0.5, "lr": 0.01}}, **{"lambda": 0.8}).training


def test_a_policy_has_the_common_settings_except_its_own() -> None:
    common = {"gamma": 0.9, "clip": SETTINGS.clip, "entropy": SETTINGS.entropy}
    assert hyperparameters(SETTINGS, ("a", "b")) == {
        "a": Hyperparameters(lr=SETTINGS.lr, lambda_=0.8, **common),
        "b": Hyperparameters(lr=0.01, lambda_=0.5, **common),
    }


def test_each_policy_follows_its_own_schedule() -> None:
    """One of the policy, one that all share, and one that a constant replaces."""
    settings = tictactoe(
        lr={"initial": 0.4, "final": 0},
        clip={"initial": 0.3, "final": 0.1, "steps": 100},
        per_policy={"b": {"lr": [[0, 0.2], [200, 0.1]], "clip": 0.2}},
    ).training
    current = hyperparameters(settings, ("a", "b"), ScheduleProgress(steps=50, budget=0.75))
    assert {policy: (values.lr, values.clip) for policy, values in current.items()} == {
        "a": pytest.approx((0.1, 0.2)),
        "b": pytest.approx((0.175, 0.2)),
    }
    assert [scheduled_hyperparameters(settings, policy) for policy in ("a", "b")] == [("lr", "clip"), ("lr",)]


@pytest.mark.parametrize(
    ("batch_scale", "steps", "factor"), [(1, WARM_UP, 1), (16, 0, 1), (16, WARM_UP // 2, 2.5), (16, 9 * WARM_UP, 4)]
)
def test_the_learning_rate_grows_with_the_batch(batch_scale: int, steps: int, factor: float) -> None:
    scaled = SETTINGS.model_copy(update={"batch_scale": batch_scale})
    at = ScheduleProgress(steps=steps, budget=0.5)
    before, after = (hyperparameters(settings, ("a", "b"), at) for settings in (SETTINGS, scaled))
    assert after == {policy: replace(values, lr=factor * values.lr) for policy, values in before.items()}


def test_an_unknown_policy_is_reported() -> None:
    with pytest.raises(ConfigError, match=r"training\.per_policy\.b: unknown policy; the league has a, c"):
        hyperparameters(SETTINGS, ("a", "c"))
