"""The loss of proximal policy optimisation."""

from typing import NamedTuple

import torch
from torch import Tensor

from training.learners.train_batch import Minibatch
from training.modules.distributions import Distribution


class PPOLoss(NamedTuple):
    """Scalars; `total` alone has a gradient that is meant to be used."""

    total: Tensor
    policy: Tensor
    value: Tensor
    entropy: Tensor
    clip_fraction: Tensor
    """Share of the steps whose probability ratio lies outside the clip range."""


def ppo_loss(
    minibatch: Minibatch,
    dist_inputs: Tensor,
    values: Tensor,
    distribution: Distribution,
    *,
    clip: float,
    entropy: float,
    value_loss: float,
) -> PPOLoss:
    """With r = π(a|s) / π_old(a|s) and the advantage A:

        L = −mean(min(r A, clip(r, 1 − ε, 1 + ε) A)) + c_v mean((V − V_target)²) − c_e mean(H(π))

    Schulman et al., 2017, "Proximal policy optimization algorithms", arXiv 1707.06347, equations 7 and 9.
    dist_inputs (k, d), values (k,): what the module answers now.
    """
    log_p, entropies = distribution.evaluate(dist_inputs, minibatch.actions)
    ratio = torch.exp(log_p - minibatch.log_p)
    clipped = ratio.clamp(1 - clip, 1 + clip)
    policy = -torch.minimum(ratio * minibatch.advantages, clipped * minibatch.advantages).mean()
    value = (values - minibatch.targets).square().mean()
    mean_entropy = entropies.mean()
    total = policy + value_loss * value - entropy * mean_entropy
    return PPOLoss(total, policy, value, mean_entropy, (clipped != ratio).float().mean())
