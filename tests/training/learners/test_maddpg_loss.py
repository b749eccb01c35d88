"""Losses by hand, on three rows: one within an episode, one truncated, one terminated."""

import pytest
import torch
from torch import Tensor

from training.learners.maddpg import actor_loss, critic_loss
from training.learners.off_policy import bootstrapped_returns

REWARDS = torch.tensor([1.0, 2.0, 3.0])
NEXT_VALUES = torch.tensor([10.0, 20.0, 30.0])
ENDED = torch.tensor([False, True, True])
TERMINATED = torch.tensor([False, False, True])
DISCOUNTS = torch.full((3,), 0.95)


def test_truncation_bootstraps_and_termination_does_not() -> None:
    targets = bootstrapped_returns(REWARDS, DISCOUNTS, TERMINATED, NEXT_VALUES)
    assert targets.tolist() == pytest.approx([1 + 9.5, 2 + 19, 3])
    broken = bootstrapped_returns(REWARDS, DISCOUNTS, ENDED, NEXT_VALUES)
    assert broken.tolist() != pytest.approx(targets.tolist()), "treating truncation as termination has no effect"


def test_the_critic_loss_is_the_mean_squared_error() -> None:
    values = torch.tensor([10.0, 22.0, 0.0], requires_grad=True)
    targets = bootstrapped_returns(REWARDS, DISCOUNTS, TERMINATED, NEXT_VALUES)
    loss = critic_loss(values, targets)
    assert loss.item() == pytest.approx((0.25 + 1 + 9) / 3)
    loss.backward()
    assert values.grad is not None
    assert values.grad.tolist() == pytest.approx([-1 / 3, 2 / 3, -2])


def test_importance_weights_scale_the_rows() -> None:
    values, weights = torch.tensor([1.0, 2.0]), torch.tensor([1.0, 0.5])
    assert critic_loss(values, torch.zeros(2), weights).item() == pytest.approx((1 + 2) / 2)


def test_the_actor_loss_increases_the_value_and_regularizes_its_outputs() -> None:
    """Q = 3 a − 1 with a = output: −mean(3 a − 1) + 0.5 mean(a²), gradient (−3 + a) / 2."""
    outputs = torch.tensor([[1.0], [2.0]], requires_grad=True)
    values: Tensor = 3 * outputs.squeeze(-1) - 1
    loss = actor_loss(values, outputs, 0.5)
    assert loss.item() == pytest.approx(-3.5 + 0.5 * 2.5)
    loss.backward()
    assert outputs.grad is not None
    assert outputs.grad.flatten().tolist() == pytest.approx([-1.0, -0.5])
