"""The loss compared with its definition, and its gradient with that of automatic differentiation."""

import inspect
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st

from league.config.schedules import ScheduleProgress
from league.errors import ConfigError
from league.policies.actions import dist_inputs_size
from league.spaces.conversion import from_gymnasium
from tests.support.leagues.training_leagues import tictactoe
from training.learners.ppo import WARM_UP, Hyperparameters, hyperparameters, ppo_loss, scheduled_hyperparameters
from training.learners.train_batch import Minibatch
from training.modules.distributions import torch_distribution
from training.modules.policy_module import MASKED_LOGIT
from training.sampling.distributions import distribution as sampled_from

ROWS, CLIP, ENTROPY, VALUE = 64, 0.2, 0.03, 0.7
OPTIONS = {"clip": CLIP, "entropy": ENTROPY, "value_loss": VALUE}


def minibatch(space: gymnasium.Space) -> Minibatch:
    torch.manual_seed(1)
    leaf = from_gymnasium(space)
    old = torch.randn(ROWS, dist_inputs_size(leaf))
    raw, log_p = sampled_from(leaf).sample(old.numpy(), np.random.default_rng(0))
    return Minibatch({}, torch.from_numpy(raw), old, torch.from_numpy(log_p), torch.randn(ROWS), torch.randn(ROWS) * 3)


SPACES = [spaces.Discrete(5), spaces.MultiDiscrete([2, 3]), spaces.Box(-1, 1, (3,))]


@pytest.mark.parametrize("space", SPACES, ids=["discrete", "multi", "box"])
def test_the_parts_of_the_loss_are_those_of_the_paper(space: gymnasium.Space) -> None:
    """J. Schulman et al., "Proximal policy optimization algorithms" (2017), equations 7 and 9."""
    steps, distribution = minibatch(space), torch_distribution(space)
    inputs, values = steps.dist_inputs + 0.4 * torch.randn_like(steps.dist_inputs), torch.randn(ROWS)
    loss = ppo_loss(steps, inputs, values, distribution, **OPTIONS)
    log_p, entropy = distribution.evaluate(inputs, steps.actions)
    ratio = (log_p - steps.log_p).exp()
    surrogate = torch.minimum(ratio * steps.advantages, ratio.clamp(1 - CLIP, 1 + CLIP) * steps.advantages)
    assert loss.policy.item() == pytest.approx(-surrogate.mean().item(), rel=1e-5)
    assert loss.value.item() == pytest.approx((values - steps.targets).square().mean().item(), rel=1e-5)
    assert loss.entropy.item() == pytest.approx(entropy.mean().item(), rel=1e-5)
    assert 0.1 < loss.clip_fraction < 0.9, "clipping must occur"


def total(steps: Minibatch, loss: Any, options: dict[str, float]) -> torch.Tensor:
    """The weighted sum of the parts of a loss, for automatic differentiation."""
    weighted = loss.policy + options["value_loss"] * loss.value - options["entropy"] * loss.entropy
    return steps.fraction * (weighted + options["magnet"] * loss.magnet_kl + options["teacher"] * loss.teacher)


WEIGHTS = st.floats(0, 2)


@settings(max_examples=30)
@given(
    st.sampled_from(SPACES),
    st.fixed_dictionaries(
        dict.fromkeys(("entropy", "value_loss", "magnet", "teacher"), WEIGHTS) | {"clip": st.floats(0.01, 0.9)}
    ),
    st.floats(0.1, 1),
    st.integers(0, 2**32 - 1),
    st.booleans(),
)
def test_the_gradient_is_that_of_automatic_differentiation(
    space: gymnasium.Space, options: dict[str, float], fraction: float, seed: int, masked: bool
) -> None:
    """In float64, for all distributions, weights and clipped or masked steps."""
    torch.manual_seed(seed)
    old = torch.randn(ROWS, dist_inputs_size(from_gymnasium(space)), dtype=torch.float64)
    if masked and isinstance(space, spaces.Discrete):
        old[: ROWS // 2, 3:] = MASKED_LOGIT
    raw, taught = (
        torch.from_numpy(sampled_from(from_gymnasium(space)).sample(old.float().numpy(), np.random.default_rng(n))[0])
        for n in (seed, seed + 1)
    )
    distribution = torch_distribution(space)
    shifted, magnet = (old + 0.5 * torch.randn_like(old) for _ in range(2))
    log_p, _ = distribution.evaluate(old, raw)
    advantages, targets, values = torch.randn(3, ROWS, dtype=torch.float64).unbind()
    steps = Minibatch({}, raw, old, log_p, advantages, targets, magnet, taught, fraction)
    outputs = shifted.requires_grad_(), values.requires_grad_()
    # The undecorated function has a graph.
    total(steps, inspect.unwrap(ppo_loss)(steps, *outputs, distribution, **options), options).backward()
    for output, gradient in zip(outputs, ppo_loss(steps, *outputs, distribution, **options).gradients, strict=True):
        torch.testing.assert_close(gradient, output.grad, rtol=1e-9, atol=1e-12)


def test_all_parts_of_the_loss_are_on_the_device_of_the_data() -> None:
    """As on a GPU."""
    space = spaces.Discrete(4)
    data = minibatch(space)
    columns = (data.actions, data.dist_inputs, data.log_p, data.advantages, data.targets)
    moved = Minibatch({}, *(column.to("meta") for column in columns))
    loss = ppo_loss(moved, moved.dist_inputs, moved.targets, torch_distribution(space), **OPTIONS)
    parts = [part for part in loss[:-2] if part is not None]
    assert {part.device.type for part in (*parts, *loss.outputs, *loss.gradients)} == {"meta"}


def test_the_loss_contains_the_divergence_from_the_magnet_and_the_cross_entropy_of_the_teachers_actions() -> None:
    torch.manual_seed(0)
    (inputs, magnet), actions = torch.randn(2, 30, 3).unbind(), torch.randint(3, (30,))
    steps = Minibatch({}, torch.zeros(30, dtype=torch.int64), inputs, torch.zeros(30), *torch.zeros(2, 30))
    losses: list[Any] = [
        ppo_loss(part, inputs, torch.zeros(30), torch_distribution(spaces.Discrete(3)), **options)
        for part, options in (
            (replace(steps, magnet=magnet, taught=actions), OPTIONS | {"magnet": 0.7, "teacher": 0.7}),
            (steps, OPTIONS),
        )
    ]
    pulled, free = losses
    p, q = torch.softmax(inputs, -1), torch.softmax(magnet, -1)
    assert pulled.magnet_kl.item() == pytest.approx((p * (p / q).log()).sum(-1).mean().item(), rel=1e-5)
    assert pulled.teacher.item() == pytest.approx(torch.nn.functional.cross_entropy(inputs, actions).item(), rel=1e-5)
    assert (free.magnet_kl, free.teacher) == (None, None)


SETTINGS = tictactoe(gamma=0.9, per_policy={"b": {"lambda": 0.5, "lr": 0.01}}, **{"lambda": 0.8}).training


def test_a_policy_has_the_common_settings_except_its_own() -> None:
    common = {"gamma": 0.9, "clip": SETTINGS.clip, "entropy": SETTINGS.entropy}
    assert hyperparameters(SETTINGS, ("a", "b")) == {
        "a": Hyperparameters(lr=SETTINGS.lr, lambda_=0.8, **common),
        "b": Hyperparameters(lr=0.01, lambda_=0.5, **common),
    }


def test_each_policy_follows_its_own_schedule() -> None:
    """One of the policy, one that all share, and one that a constant replaces."""
    settings = tictactoe(
        lr={"initial": 0.4, "final": 0},
        clip={"initial": 0.3, "final": 0.1, "steps": 100},
        per_policy={"b": {"lr": [[0, 0.2], [200, 0.1]], "clip": 0.2}},
    ).training
    current = hyperparameters(settings, ("a", "b"), ScheduleProgress(steps=50, budget=0.75))
    assert {policy: (values.lr, values.clip) for policy, values in current.items()} == {
        "a": pytest.approx((0.1, 0.2)),
        "b": pytest.approx((0.175, 0.2)),
    }
    assert [scheduled_hyperparameters(settings, policy) for policy in ("a", "b")] == [("lr", "clip"), ("lr",)]


@pytest.mark.parametrize(
    ("batch_scale", "steps", "factor"), [(1, WARM_UP, 1), (16, 0, 1), (16, WARM_UP // 2, 2.5), (16, 9 * WARM_UP, 4)]
)
def test_the_learning_rate_grows_with_the_batch(batch_scale: int, steps: int, factor: float) -> None:
    scaled = SETTINGS.model_copy(update={"batch_scale": batch_scale})
    at = ScheduleProgress(steps=steps, budget=0.5)
    before, after = (hyperparameters(settings, ("a", "b"), at) for settings in (SETTINGS, scaled))
    assert after == {policy: replace(values, lr=factor * values.lr) for policy, values in before.items()}


def test_an_unknown_policy_is_reported() -> None:
    with pytest.raises(ConfigError, match=r"training\.per_policy\.b: unknown policy; the league has a, c"):
        hyperparameters(SETTINGS, ("a", "c"))
