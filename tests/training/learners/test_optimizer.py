"""The optimiser compared with torch's own functions."""

import copy

import gymnasium
import pytest
import torch
from torch import nn

from league.errors import InvalidInput
from training.learners.optimizer import ClippedAdam, check_gradients
from training.learners.processor import fast_products, keep_memory
from training.modules.encoder import Encoder, has_bfloat16

LR, MAX_NORM = 0.1, 0.5


def network() -> nn.Module:
    torch.manual_seed(0)
    convolution = nn.Conv2d(2, 3, 2)
    convolution.weight.data = convolution.weight.data.to(memory_format=torch.channels_last)
    return nn.Sequential(convolution, nn.Flatten(), nn.Linear(12, 4), nn.Tanh(), nn.Linear(4, 2))


def loss(module: nn.Module, scale: float) -> torch.Tensor:
    torch.manual_seed(1)
    return scale * module(torch.randn(5, 2, 3, 3)).square().mean()


def weights(module: nn.Module) -> torch.Tensor:
    return torch.cat([parameter.detach().flatten() for parameter in module.parameters()])


@pytest.mark.parametrize("scale", [1e-3, 1e3], ids=["below", "clipped"])
def test_steps_equal_those_of_torch_with_clipped_gradients(scale: float) -> None:
    module = network()
    reference = copy.deepcopy(module)
    optimizer = ClippedAdam(module.parameters(), lr=LR, max_norm=MAX_NORM)
    adam = torch.optim.Adam(reference.parameters(), lr=LR)
    for _ in range(3):
        adam.zero_grad()
        loss(module, scale).backward()
        loss(reference, scale).backward()
        norm = optimizer.clip_and_step()
        torch.testing.assert_close(norm, nn.utils.clip_grad_norm_(reference.parameters(), MAX_NORM))
        adam.step()
        torch.testing.assert_close(weights(module), weights(reference))


def test_parameters_keep_their_values_and_layouts() -> None:
    module = network()
    before = copy.deepcopy(module)
    ClippedAdam(module.parameters(), lr=LR, max_norm=MAX_NORM)
    for parameter, expected in zip(module.parameters(), before.parameters(), strict=True):
        assert torch.equal(parameter, expected)
        assert parameter.stride() == expected.stride()


def test_the_state_is_that_of_torch() -> None:
    module, reference = network(), network()
    optimizer = ClippedAdam(module.parameters(), lr=LR, max_norm=1e6)
    adam = torch.optim.Adam(reference.parameters(), lr=LR, fused=True)
    for network_, step in ((module, optimizer.clip_and_step), (reference, adam.step)):
        for scale in (1.0, 2.0):
            network_.zero_grad()
            loss(network_, scale).backward()
            step()
    assert optimizer.state_dict()["param_groups"] == adam.state_dict()["param_groups"]
    torch.testing.assert_close(optimizer.state_dict()["state"], adam.state_dict()["state"])


def test_training_continues_from_a_state() -> None:
    module = network()
    optimizer = ClippedAdam(module.parameters(), lr=LR, max_norm=MAX_NORM)
    loss(module, 1.0).backward()
    optimizer.clip_and_step()
    resumed = copy.deepcopy(module)
    restored = ClippedAdam(resumed.parameters(), lr=0.5 * LR, max_norm=MAX_NORM)
    loss(resumed, 7.0).backward()
    restored.clip_and_step()
    resumed.load_state_dict(module.state_dict())
    restored.load_state_dict(copy.deepcopy(optimizer.state_dict()))
    for network_, adam in ((module, optimizer), (resumed, restored)):
        loss(network_, 2.0).backward()
        adam.clip_and_step()
    assert torch.equal(weights(module), weights(resumed))


def test_the_state_before_the_first_step_is_that_of_new_optimizers() -> None:
    module = network()
    optimizer = ClippedAdam(module.parameters(), lr=LR, max_norm=MAX_NORM)
    new = copy.deepcopy(optimizer.state_dict()["state"])
    loss(module, 1.0).backward()
    optimizer.clip_and_step()
    optimizer.load_state_dict(torch.optim.Adam(network().parameters(), lr=LR).state_dict())
    torch.testing.assert_close(optimizer.state_dict()["state"], new)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_gradient_that_is_not_finite_changes_nothing(value: float, caplog: pytest.LogCaptureFixture) -> None:
    module = network()
    optimizer = ClippedAdam(module.parameters(), lr=LR, max_norm=MAX_NORM)
    loss(module, 1.0).backward()
    optimizer.clip_and_step()
    before, state = weights(module), copy.deepcopy(optimizer.state_dict())
    check_gradients({"a": optimizer})
    assert not caplog.text
    loss(module, value).backward()
    assert not optimizer.clip_and_step().isfinite()
    assert torch.equal(weights(module), before)
    torch.testing.assert_close(optimizer.state_dict()["state"], state["state"])
    check_gradients({"a": optimizer})
    assert "Dropped a non-finite gradient of a: 1 in this update." in caplog.text
    assert optimizer.take_dropped() == 0


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_network_that_learns_nothing_is_an_error(value: float) -> None:
    """Observations of 1e18 give such gradients from the first one on, and training would report progress to its end."""
    module = network()
    optimizer = ClippedAdam(module.parameters(), lr=LR, max_norm=MAX_NORM)
    check_gradients({"a": optimizer})
    for _ in range(2):
        loss(module, value).backward()
        optimizer.clip_and_step()
    with pytest.raises(
        InvalidInput, match=r"^training: all 2 gradients of a are not finite: .*normalize_observations$"
    ):
        check_gradients({"a": optimizer})


def test_products_are_close_and_the_setting_is_restored() -> None:
    torch.manual_seed(0)
    left, right = torch.randn(512, 256), torch.randn(256, 256)
    exact = left.double() @ right.double()
    before = torch.backends.mkldnn.matmul.fp32_precision
    keep_memory()
    with fast_products():
        # The factors have 8 significant bits where the processor multiplies bfloat16.
        torch.testing.assert_close((left @ right).double(), exact, atol=0.3, rtol=0.02)
    assert torch.backends.mkldnn.matmul.fp32_precision == before
    torch.testing.assert_close((left @ right).double(), exact, atol=1e-3, rtol=1e-5)


def test_encoders_round_only_while_learning_and_only_where_the_processor_multiplies_bfloat16() -> None:
    torch.manual_seed(0)
    space = gymnasium.spaces.Dict(observation=gymnasium.spaces.Box(-1, 1, (16,)))
    encoder, observations = Encoder(space, hidden=(32,)), {"observation": torch.rand(8, 16)}
    exact = encoder(observations)
    with fast_products():
        rounded = encoder(observations)
    assert rounded.dtype == torch.float32
    assert torch.equal(rounded, rounded.bfloat16().float()) == has_bfloat16()
    torch.testing.assert_close(rounded, exact, atol=0.05, rtol=0.02)
    assert torch.equal(encoder(observations), exact)
