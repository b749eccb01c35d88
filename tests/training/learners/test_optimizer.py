"""The optimiser compared with torch's own functions."""

import copy

import pytest
import torch
from torch import nn

from training.learners.optimizer import ClippedAdam, warn_of_dropped_gradients

LR, MAX_NORM = 0.1, 0.5


def network() -> nn.Module:
    torch.manual_seed(0)
    return nn.Sequential(nn.Linear(3, 4), nn.Tanh(), nn.Linear(4, 2))


def loss(module: nn.Module, scale: float) -> torch.Tensor:
    torch.manual_seed(1)
    return scale * module(torch.randn(5, 3)).square().mean()


def weights(module: nn.Module) -> torch.Tensor:
    return nn.utils.parameters_to_vector(module.parameters()).detach().clone()


@pytest.mark.parametrize("scale", [1e-3, 1e3], ids=["below", "clipped"])
def test_steps_equal_those_of_torch_with_clipped_gradients(scale: float) -> None:
    module = network()
    reference = copy.deepcopy(module)
    optimizer = ClippedAdam(module.parameters(), lr=LR, max_norm=MAX_NORM)
    adam = torch.optim.Adam(reference.parameters(), lr=LR)
    for _ in range(3):
        optimizer.zero_grad()
        adam.zero_grad()
        loss(module, scale).backward()
        loss(reference, scale).backward()
        norm = optimizer.clip_and_step()
        torch.testing.assert_close(norm, nn.utils.clip_grad_norm_(reference.parameters(), MAX_NORM))
        adam.step()
        torch.testing.assert_close(weights(module), weights(reference))


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_gradient_that_is_not_finite_changes_nothing(value: float, caplog: pytest.LogCaptureFixture) -> None:
    module = network()
    optimizer = ClippedAdam(module.parameters(), lr=LR, max_norm=MAX_NORM)
    loss(module, 1.0).backward()
    optimizer.clip_and_step()
    before, state = weights(module), copy.deepcopy(optimizer.state_dict())
    warn_of_dropped_gradients({"a": optimizer})
    assert not caplog.text
    loss(module, value).backward()
    assert not optimizer.clip_and_step().isfinite()
    assert torch.equal(weights(module), before)
    torch.testing.assert_close(optimizer.state_dict()["state"], state["state"])
    warn_of_dropped_gradients({"a": optimizer})
    assert "Dropped a non-finite gradient of a: 1 in this update." in caplog.text
    assert optimizer.take_dropped() == 0
