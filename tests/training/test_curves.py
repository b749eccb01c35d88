from typing import Any

from ray.rllib.utils.metrics import ENV_RUNNER_RESULTS, EPISODE_MODULE_RETURN_MEAN, EPISODE_RETURN_MEAN, LEARNER_RESULTS

from league.environments.building import interface
from tests.training.leagues import tictactoe
from training.curves import curves


def test_an_update_in_which_no_episode_ended_has_no_returns() -> None:
    """RLlib tells NaN of what it was told once; a loss that is NaN has diverged, and shows."""
    result: dict[str, Any] = {
        ENV_RUNNER_RESULTS: {EPISODE_RETURN_MEAN: float("nan"), EPISODE_MODULE_RETURN_MEAN: {"shared": float("nan")}},
        LEARNER_RESULTS: {"shared": {"policy_loss": float("nan"), "loss": 2.0}},
    }
    found = curves(result, interface(tictactoe()))
    assert found.keys() == {"shared/policy_loss", "shared/loss"}
    result[ENV_RUNNER_RESULTS][EPISODE_RETURN_MEAN] = 1.5
    assert curves(result, interface(tictactoe()))["return"] == 1.5
