"""Gumbel-softmax against finite differences and the closed form of its gradient, and what critics take of actions."""

import numpy as np
import pytest
import torch
from gymnasium import spaces
from scipy import stats

from training.modules.actor_critic import MASKED
from training.modules.relaxed import gumbel, gumbel_softmax, relaxed

ROWS = 20_000


def softmax(values: np.ndarray) -> np.ndarray:
    weights = np.exp(values - values.max(axis=-1, keepdims=True))
    return weights / weights.sum(axis=-1, keepdims=True)


@pytest.mark.parametrize("temperature", [0.5, 1.0, 2.0])
def test_the_gradient_is_that_of_the_relaxation(temperature: float) -> None:
    torch.manual_seed(0)
    logits = torch.randn(5, 4, dtype=torch.float64, requires_grad=True)
    noise, weights = gumbel(logits.detach()), torch.randn(5, 4, dtype=torch.float64)
    (gumbel_softmax(logits, temperature, noise) * weights).sum().backward()
    before = logits.detach().numpy()

    def value(moved: np.ndarray) -> float:
        return float((softmax((moved + noise.numpy()) / temperature) * weights.numpy()).sum())

    step = 1e-6
    for index in np.ndindex(5, 4):
        change = np.zeros((5, 4))
        change[index] = step
        slope = (value(before + change) - value(before - change)) / (2 * step)
        assert logits.grad is not None
        assert logits.grad[index].item() == pytest.approx(slope, abs=1e-7)


def test_golden_numbers() -> None:
    """y = softmax(ln 2, 0, ln 1) = (1/2, 1/4, 1/4) at τ = 1; ∂y_0/∂logits = y_0 (δ − y) = (1/4, −1/8, −1/8)."""
    logits = torch.tensor([[np.log(2) - 0.3, 0.2, 0.0]], dtype=torch.float64, requires_grad=True)
    noise = torch.tensor([[0.3, -0.2, 0.0]], dtype=torch.float64)
    drawn = gumbel_softmax(logits, 1.0, noise)
    assert drawn.tolist() == [[1.0, 0.0, 0.0]]
    drawn[0, 0].backward()
    assert logits.grad is not None
    assert logits.grad.numpy() == pytest.approx(np.array([[0.25, -0.125, -0.125]]))


@pytest.mark.parametrize("temperature", [0.3, 3.0])
def test_draws_as_softmax_whatever_the_temperature(temperature: float) -> None:
    torch.manual_seed(1)
    logits = torch.tensor([0.0, 1.0, -1.0, 2.0]).expand(ROWS, 4)
    drawn = gumbel_softmax(logits, temperature, gumbel(logits))
    assert torch.equal(drawn.sum(1), torch.ones(ROWS)), "one-hot"
    assert set(drawn.unique().tolist()) == {0.0, 1.0}
    counts = drawn.sum(0).numpy()
    assert stats.chisquare(counts, ROWS * softmax(logits[0].numpy())).pvalue > 1e-4


def test_a_masked_action_is_never_drawn_and_has_no_gradient() -> None:
    torch.manual_seed(2)
    logits = torch.randn(ROWS, 3, requires_grad=True)
    masked = torch.where(torch.tensor([True, False, True]), logits, MASKED)
    drawn = gumbel_softmax(masked, 1.0, gumbel(masked))
    assert not drawn[:, 1].any()
    (drawn * torch.randn(3)).sum().backward()
    assert logits.grad is not None
    assert torch.isfinite(logits.grad).all()
    assert not logits.grad[:, 1].any()
    assert logits.grad[:, [0, 2]].abs().max() > 0


def test_the_smallest_uniform_number_chooses_no_masked_action(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch, "rand_like", torch.zeros_like)
    assert torch.isfinite(gumbel(torch.zeros(3))).all()


def test_without_gradients_the_same_is_drawn() -> None:
    torch.manual_seed(3)
    logits = torch.randn(ROWS, 4)
    noise = gumbel(logits)
    with torch.no_grad():
        without = gumbel_softmax(logits, 1.0, noise)
    assert torch.equal(gumbel_softmax(logits, 1.0, noise), without)


def test_choices_are_one_hot() -> None:
    pair = relaxed(spaces.MultiDiscrete([[2], [3]]))
    assert pair.width == 5
    assert pair.encode(torch.tensor([[1, 0], [0, 2]])).tolist() == [[0, 1, 1, 0, 0], [1, 0, 0, 0, 1]]
    single = relaxed(spaces.Discrete(3, start=7))
    assert single.encode(torch.tensor([2, 0])).tolist() == [[0, 0, 1], [1, 0, 0]]


def test_each_element_of_several_is_drawn_from_its_own_logits() -> None:
    pair = relaxed(spaces.MultiDiscrete([2, 3]))
    sure = torch.tensor([[MASKED, 0.0, MASKED, MASKED, 0.0]], requires_grad=True)
    assert pair.sample(sure, 1.0).tolist() == [[0, 1, 0, 0, 1]]


def test_numbers_are_clipped_as_the_environment_clips_them() -> None:
    low, high = np.array([0, -np.inf, 2, -np.inf]), np.array([5, np.inf, np.inf, 3])
    box = relaxed(spaces.Box(low.astype(np.float32), high.astype(np.float32)))
    raw = torch.tensor([[1.5, 40.0, 1.0, 9.0], [-2.0, -40.0, 7.0, -9.0]])
    assert box.encode(raw).tolist() == [[1, 40, 2, 3], [-1, -40, 7, -9]]
    means = torch.tensor([[0.5, -0.5, 2.5, 1.0]], requires_grad=True)
    drawn = box.sample(torch.cat([means, torch.zeros(1, 4)], dim=-1), 1.0)
    assert torch.equal(drawn, means), "deterministic"
