"""Targets computed by hand."""

import pytest
import torch
from torch import Tensor

from training.learners.maddpg import actor_loss, critic_loss
from training.learners.off_policy import best_legal_action, bootstrapped_returns, next_actions, project_distribution

ONLINE = torch.tensor([[1.0, 5.0, 9.0], [-3.0, -2.0, -1.0], [0.0, 0.0, 0.0]])
TARGET = torch.tensor([[7.0, 2.0, 3.0], [-4.0, -8.0, 4.0], [1.0, 2.0, 3.0]])
MASK = torch.tensor([[1, 1, 0], [1, 1, 0], [0, 1, 0]], dtype=torch.int8)


def test_double_dqn_selects_legal_actions_by_the_online_network() -> None:
    assert next_actions(ONLINE, TARGET, MASK).tolist() == [1, 1, 1]
    assert next_actions(None, TARGET, MASK).tolist() == [0, 0, 1]
    assert next_actions(ONLINE, TARGET, None).tolist() == [2, 2, 0]


def test_a_mask_without_legal_actions_is_ignored() -> None:
    """The mask of an agent that is truncated in another agent's turn."""
    assert best_legal_action(ONLINE, torch.zeros(3, 3)).tolist() == [2, 2, 0]


ATOMS = torch.tensor([-1.0, 0.0, 1.0])


def project(probabilities: list[float], reward: float, discount: float, terminated: bool) -> list[float]:
    arguments = torch.tensor([reward]), torch.tensor([discount]), torch.tensor([terminated])
    return project_distribution(torch.tensor([probabilities]), ATOMS, *arguments)[0].tolist()


def test_a_distribution_is_projected_onto_its_atoms() -> None:
    """Returns 0.25 + 0.5·(−1, 0, 1) = −0.25, 0.25, 0.75, each split between the adjacent atoms."""
    expected = [0.2 * 0.25, 0.2 * 0.75 + 0.5 * 0.75 + 0.3 * 0.25, 0.5 * 0.25 + 0.3 * 0.75]
    assert project([0.2, 0.5, 0.3], 0.25, 0.5, False) == pytest.approx(expected)


def test_terminated_returns_are_rewards_and_returns_are_clipped_to_the_atoms() -> None:
    assert project([0.2, 0.5, 0.3], 0.5, 0.9, True) == pytest.approx([0, 0.5, 0.5])
    assert project([0.2, 0.5, 0.3], 3.0, 1.0, False) == pytest.approx([0, 0, 1])
    assert project([0.2, 0.5, 0.3], 0.0, 1.0, False) == pytest.approx([0.2, 0.5, 0.3])


REWARDS = torch.tensor([1.0, 2.0, 3.0])
NEXT_VALUES = torch.tensor([10.0, 20.0, 30.0])
TERMINATED = torch.tensor([False, False, True])
DISCOUNTS = torch.full((3,), 0.95)


def test_truncation_bootstraps_and_termination_does_not() -> None:
    """The second step is truncated, the third one terminated."""
    targets = bootstrapped_returns(REWARDS, DISCOUNTS, TERMINATED, torch.tensor([10.0, 20.0, -1e9]))
    assert targets.tolist() == pytest.approx([1 + 9.5, 2 + 19, 3])


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
