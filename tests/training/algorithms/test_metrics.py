from typing import Any

from ray.rllib.utils.metrics import ENV_RUNNER_RESULTS, EPISODE_MODULE_RETURN_MEAN, EPISODE_RETURN_MEAN, LEARNER_RESULTS

from league.environments.building import interface
from tests.support.leagues.training_leagues import tictactoe
from training.algorithms.metrics import OFF_POLICY_METRICS, PPO_METRICS, training_metrics


def test_an_update_without_finished_episodes_has_no_returns() -> None:
    """RLlib reports NaN for metrics without new values; a NaN loss means divergence and is kept."""
    result: dict[str, Any] = {
        ENV_RUNNER_RESULTS: {EPISODE_RETURN_MEAN: float("nan"), EPISODE_MODULE_RETURN_MEAN: {"shared": float("nan")}},
        LEARNER_RESULTS: {"shared": {"policy_loss": float("nan"), "loss": 2.0}},
    }
    found = training_metrics(result, interface(tictactoe()), PPO_METRICS | OFF_POLICY_METRICS)
    assert found.keys() == {"shared/policy_loss", "shared/loss"}
    result[ENV_RUNNER_RESULTS][EPISODE_RETURN_MEAN] = 1.5
    assert training_metrics(result, interface(tictactoe()))["return"] == 1.5
