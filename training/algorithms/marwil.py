"""MARWIL, learning from recorded games: Wang et al., 2018, "Exponentially weighted imitation learning for batched
historical data". With β = 0, it is behaviour cloning.

An iteration is that of PPO, with recorded chunks in place of played ones, and with another loss.
"""

from pathlib import Path
from typing import Any

import torch
from ray.rllib.algorithms import ppo
from ray.rllib.core.columns import Columns
from torch import Tensor

from league.config.league import LeagueConfig
from league.config.marwil import MARWILConfig
from league.interface import Interface
from league.settings import Storage
from training.algorithms.metrics import PPO_METRICS
from training.algorithms.ppo import PPO
from training.learners.ppo import PPOLearner, PPOLoss
from training.learners.train_batch import Minibatch
from training.sampling.recorded_games import RecordedRunner, files

MARWIL_METRICS = {
    name: PPO_METRICS[name] for name in ("policy_loss", "value_loss", "explained_variance", "gradient_norm")
}
MOST = 3.0
"""Largest exponent of an action's weight: a few rare actions must not be all that is learned."""


class MARWILLearner(PPOLearner):
    """Imitates the actions of a batch, weighted by their advantages, and learns their returns."""

    @torch.no_grad()
    def compute_loss_for_module(
        self, *, module_id: str, batch: Minibatch, fwd_out: dict[str, Tensor], **_: Any
    ) -> PPOLoss:
        """Return the loss of one policy on some steps, with the standardised advantages A:

            L = −mean(exp(β A) log π(a|s)) + c_v mean((V − V_target)²)

        Equation 3 of the paper.
        """
        assert isinstance(self.settings, MARWILConfig)
        distribution = self.module[module_id].distribution
        dist_inputs, values = fwd_out[Columns.ACTION_DIST_INPUTS], fwd_out[Columns.VF_PREDS]
        log_p, entropies = distribution.evaluate(dist_inputs, batch.actions)
        weights = torch.exp((self.settings.beta * batch.advantages).clamp(max=MOST))
        error, share = values - batch.targets, batch.fraction / len(values)
        return PPOLoss(
            policy=-(weights * log_p).mean(),
            value=error.square().mean(),
            entropy=entropies.mean(),
            clip_fraction=torch.zeros(()),
            magnet_kl=None,
            teacher=None,
            outputs=(dist_inputs, values),
            gradients=(
                distribution.gradient(dist_inputs, batch.actions, weights * -share, 0.0),
                error * (2 * self.settings.value_loss * share),
            ),
        )


class MARWIL(PPO):
    """PPO's iteration on recorded games."""

    settings_class = MARWILConfig
    learner_class = MARWILLearner
    runner_class = RecordedRunner
    curves = MARWIL_METRICS

    @classmethod
    def algorithm_config(cls, league: LeagueConfig, interface: Interface, storage: Storage | None) -> ppo.PPOConfig:
        """See `training.algorithms.rllib_config.algorithm_config`. Raises ConfigError also without recorded games."""
        assert isinstance(league.training, MARWILConfig)
        files(Path(league.training.data), interface)
        return super().algorithm_config(league, interface, storage)
