"""Compared with torch's distributions, and with the NumPy ones of the runners."""

import numpy as np
import pytest
import torch
from gymnasium import spaces
from torch import Tensor, distributions

from league.policies.actions import dist_inputs_size
from league.spaces.conversion import from_gymnasium
from training.modules.distributions import torch_distribution
from training.sampling.distributions import distribution as sampled_from

DISCRETE, PAIR, BOX = spaces.Discrete(4, start=2), spaces.MultiDiscrete([[2], [3]]), spaces.Box(-1, 1, (2, 1))
SPACES = pytest.mark.parametrize("space", [DISCRETE, PAIR, BOX], ids=["discrete", "multi", "box"])
ROWS = 50


def reference(space: spaces.Space, inputs: Tensor) -> list[distributions.Distribution]:
    """torch's distributions, one for each element."""
    if space is BOX:
        return [distributions.Normal(inputs[:, i], inputs[:, 2 + i].exp()) for i in range(2)]
    parts = [inputs] if space is DISCRETE else [inputs[:, :2], inputs[:, 2:]]
    return [distributions.Categorical(logits=part) for part in parts]


def dist_inputs(space: spaces.Space, seed: int) -> Tensor:
    torch.manual_seed(seed)
    return torch.randn(ROWS, dist_inputs_size(from_gymnasium(space)))


@SPACES
def test_evaluation_equals_torch(space: spaces.Space) -> None:
    old, new = dist_inputs(space, 0), dist_inputs(space, 1)
    ours, elements = torch_distribution(space), reference(space, old)
    raw = torch.stack([element.sample() for element in elements], dim=-1)
    log_p, entropy = ours.evaluate(old, raw[:, 0] if space is DISCRETE else raw)
    expected = sum(element.log_prob(raw[:, i]) for i, element in enumerate(elements))
    assert torch.allclose(log_p, expected, atol=1e-5)
    assert torch.allclose(entropy, sum(element.entropy() for element in elements), atol=1e-5)
    pairs = zip(elements, reference(space, new), strict=True)
    assert torch.allclose(
        ours.divergence(old, new), sum(distributions.kl_divergence(a, b) for a, b in pairs), atol=1e-4
    )
    torch.testing.assert_close(ours.divergence(old, old), torch.zeros(ROWS))
    mode = torch.stack([element.mode for element in elements], dim=-1)
    assert torch.equal(ours.mode(old), mode[:, 0] if space is DISCRETE else mode)


@SPACES
def test_evaluation_equals_the_distribution_of_runners(space: spaces.Space) -> None:
    inputs = dist_inputs(space, 2)
    runner = sampled_from(from_gymnasium(space))
    raw, log_p = runner.sample(inputs.numpy(), np.random.default_rng(0))
    ours_log_p, entropy = torch_distribution(space).evaluate(inputs, torch.from_numpy(raw))
    np.testing.assert_allclose(ours_log_p, log_p, atol=1e-5)
    np.testing.assert_allclose(entropy, runner.entropy(inputs.numpy()), atol=1e-5)
    assert (torch_distribution(space).mode(inputs).numpy() == runner.mode(inputs.numpy())[0]).all()
