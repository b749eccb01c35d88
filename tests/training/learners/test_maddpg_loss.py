"""By hand, on three rows: one in the middle of an episode, one truncated, one terminated."""

import pytest
import torch
from torch import Tensor

from training.learners.maddpg_loss import actor_loss, critic_loss, td_target

REWARDS = torch.tensor([1.0, 2.0, 3.0])
NEXT_VALUES = torch.tensor([10.0, 20.0, 30.0])
ENDED = torch.tensor([False, True, True])
TERMINATED = torch.tensor([False, False, True])
DISCOUNTS = torch.full((3,), 0.95)


def test_what_is_truncated_bootstraps_and_what_is_terminated_does_not() -> None:
    targets = td_target(REWARDS, NEXT_VALUES, TERMINATED, DISCOUNTS)
    assert targets.tolist() == pytest.approx([1 + 9.5, 2 + 19, 3])
    broken = td_target(REWARDS, NEXT_VALUES, ENDED, DISCOUNTS)
    assert broken.tolist() != pytest.approx(targets.tolist()), "truncation taken for termination shows"


def test_the_critics_loss_is_the_mean_square_and_its_gradient_the_error() -> None:
    values = torch.tensor([10.0, 22.0, 0.0], requires_grad=True)
    targets = td_target(REWARDS, NEXT_VALUES, TERMINATED, DISCOUNTS)
    loss = critic_loss(values, targets)
    assert loss.item() == pytest.approx((0.25 + 1 + 9) / 3)
    loss.backward()
    assert values.grad is not None
    assert values.grad.tolist() == pytest.approx([-1 / 3, 2 / 3, -2])


def test_importance_weights_the_rows() -> None:
    values, weights = torch.tensor([1.0, 2.0]), torch.tensor([1.0, 0.5])
    assert critic_loss(values, torch.zeros(2), weights).item() == pytest.approx((1 + 2) / 2)


def test_the_actors_loss_raises_the_value_and_keeps_its_answers_small() -> None:
    """Q = 3 a − 1 with a = answer: −mean(3 a − 1) + 0.5 mean(a²), gradient (−3 + a) / 2."""
    answers = torch.tensor([[1.0], [2.0]], requires_grad=True)
    values: Tensor = 3 * answers.squeeze(-1) - 1
    loss = actor_loss(values, answers, 0.5)
    assert loss.item() == pytest.approx(-3.5 + 0.5 * 2.5)
    loss.backward()
    assert answers.grad is not None
    assert answers.grad.flatten().tolist() == pytest.approx([-1.0, -0.5])
