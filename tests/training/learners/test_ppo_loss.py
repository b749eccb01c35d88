"""The loss and its gradient, compared with RLlib's."""

from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.algorithms.ppo.torch.ppo_torch_learner import PPOTorchLearner
from ray.rllib.core.columns import Columns
from ray.rllib.core.distribution.torch.torch_distribution import (
    TorchCategorical,
    TorchDiagGaussian,
    TorchMultiCategorical,
)
from ray.rllib.evaluation.postprocessing import Postprocessing

from league.policies.actions import dist_inputs_size
from league.spaces.conversion import from_gymnasium
from training.learners.ppo import ppo_loss
from training.learners.train_batch import Minibatch
from training.modules.distributions import torch_distribution
from training.sampling.distributions import distribution as sampled_from

ROWS, CLIP, ENTROPY, VALUE = 64, 0.2, 0.03, 0.7


def minibatch(space: gymnasium.Space) -> Minibatch:
    torch.manual_seed(1)
    leaf = from_gymnasium(space)
    old = torch.randn(ROWS, dist_inputs_size(leaf))
    raw, log_p = sampled_from(leaf).sample(old.numpy(), np.random.default_rng(0))
    return Minibatch({}, torch.from_numpy(raw), old, torch.from_numpy(log_p), torch.randn(ROWS), torch.randn(ROWS) * 3)


def rllib_loss(minibatch: Minibatch, dist_inputs: torch.Tensor, values: torch.Tensor, dist: Any) -> tuple[Any, dict]:
    module = SimpleNamespace(
        get_train_action_dist_cls=lambda: dist,
        get_exploration_action_dist_cls=lambda: dist,
        compute_values=lambda *_, **__: values,
    )
    logged: dict[str, torch.Tensor] = {}
    learner = SimpleNamespace(
        module={"a": SimpleNamespace(unwrapped=lambda: module)},
        entropy_coeff_schedulers_per_module={"a": SimpleNamespace(get_current_value=lambda: ENTROPY)},
        metrics=SimpleNamespace(log_dict=lambda values, **_: logged.update(values)),
    )
    config = PPOConfig().training(
        clip_param=CLIP, vf_loss_coeff=VALUE, vf_clip_param=float("inf"), use_kl_loss=False, entropy_coeff=ENTROPY
    )
    batch = {
        Columns.ACTIONS: minibatch.actions,
        Columns.ACTION_LOGP: minibatch.log_p,
        Columns.ACTION_DIST_INPUTS: minibatch.dist_inputs,
        Postprocessing.ADVANTAGES: minibatch.advantages,
        Postprocessing.VALUE_TARGETS: minibatch.targets,
    }
    answers = {Columns.ACTION_DIST_INPUTS: dist_inputs}
    loss = PPOTorchLearner.compute_loss_for_module(learner, module_id="a", config=config, batch=batch, fwd_out=answers)
    return loss, logged


@pytest.mark.parametrize(
    ("space", "dist"),
    [
        (spaces.Discrete(5), TorchCategorical),
        (spaces.MultiDiscrete([2, 3]), TorchMultiCategorical.get_partial_dist_cls(space=None, input_lens=[2, 3])),
        (spaces.Box(-1, 1, (3,)), TorchDiagGaussian),
    ],
    ids=["discrete", "multi", "box"],
)
def test_loss_and_gradient_equal_rllibs(space: gymnasium.Space, dist: Any) -> None:
    steps = minibatch(space)
    new, values = (steps.dist_inputs + 0.4 * torch.randn_like(steps.dist_inputs)), torch.randn(ROWS)
    gradients, losses = [], []
    for theirs in (True, False):
        inputs, predicted = new.clone().requires_grad_(), values.clone().requires_grad_()
        if theirs:
            total, logged = rllib_loss(steps, inputs, predicted, dist)
        else:
            ours = ppo_loss(
                steps, inputs, predicted, torch_distribution(space), clip=CLIP, entropy=ENTROPY, value_loss=VALUE
            )
            total = ours.total
        total.backward()
        gradients.append((inputs.grad, predicted.grad))
        losses.append(total.item())
    assert losses[0] == pytest.approx(losses[1], rel=1e-5)
    for expected, found in zip(*gradients, strict=True):
        assert torch.allclose(expected, found, atol=1e-6)
    assert ours.policy.item() == pytest.approx(logged["policy_loss"].item(), rel=1e-5)
    assert ours.value.item() == pytest.approx(logged["vf_loss"].item(), rel=1e-5)
    assert ours.entropy.item() == pytest.approx(logged["entropy"].item(), rel=1e-5)
    assert 0.1 < ours.clip_fraction < 0.9, "clipping must occur"


def test_an_unchanged_policy_is_not_clipped() -> None:
    steps = minibatch(spaces.Discrete(5))
    loss = ppo_loss(
        steps,
        steps.dist_inputs,
        steps.targets,
        torch_distribution(spaces.Discrete(5)),
        clip=CLIP,
        entropy=0,
        value_loss=VALUE,
    )
    assert loss.clip_fraction == 0
    assert loss.total.item() == pytest.approx(-steps.advantages.mean().item(), abs=1e-6)


def test_all_parts_of_the_loss_are_on_the_device_of_the_data() -> None:
    """As on a GPU: without a magnet or a teacher, their parts are 0 on the same device."""
    space = spaces.Discrete(4)
    data = minibatch(space)
    columns = (data.actions, data.dist_inputs, data.log_p, data.advantages, data.targets)
    moved = Minibatch({}, *(column.to("meta") for column in columns))
    options = {"clip": CLIP, "entropy": ENTROPY, "value_loss": VALUE}
    loss = ppo_loss(moved, moved.dist_inputs, moved.targets, torch_distribution(space), **options)
    assert {part.device.type for part in loss} == {"meta"}
