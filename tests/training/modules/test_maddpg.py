"""Actors, critics, and the encoding of actions for critics."""

from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from ray.rllib.core.columns import Columns
from scipy import stats

from training.modules.maddpg import MIN_DEVIATION, Actor, Critic, critic_actions, gumbel, gumbel_softmax
from training.modules.policy_module import MASKED_LOGIT

DRAWS = 20_000


def softmax(values: np.ndarray) -> np.ndarray:
    weights = np.exp(values - values.max(axis=-1, keepdims=True))
    return weights / weights.sum(axis=-1, keepdims=True)


@pytest.mark.parametrize("temperature", [0.5, 2.0])
def test_the_gradient_is_that_of_the_relaxation(temperature: float) -> None:
    torch.manual_seed(0)
    logits = torch.randn(5, 4, dtype=torch.float64, requires_grad=True)
    noise, weights = gumbel(logits.detach()), torch.randn(5, 4, dtype=torch.float64)
    (gumbel_softmax(logits, temperature, noise) * weights).sum().backward()
    values = logits.detach().numpy()

    def value(moved: np.ndarray) -> float:
        return float((softmax((moved + noise.numpy()) / temperature) * weights.numpy()).sum())

    step = 1e-6
    for index in np.ndindex(5, 4):
        change = np.zeros((5, 4))
        change[index] = step
        slope = (value(values + change) - value(values - change)) / (2 * step)
        assert logits.grad is not None
        assert logits.grad[index].item() == pytest.approx(slope, abs=1e-7)


@pytest.mark.parametrize("temperature", [0.3, 3.0])
def test_samples_follow_the_softmax_at_any_temperature(temperature: float) -> None:
    torch.manual_seed(1)
    logits = torch.tensor([0.0, 1.0, -1.0, 2.0]).expand(DRAWS, 4)
    drawn = gumbel_softmax(logits, temperature, gumbel(logits))
    assert torch.equal(drawn.sum(1), torch.ones(DRAWS)), "one-hot"
    assert set(drawn.unique().tolist()) == {0.0, 1.0}
    counts = drawn.sum(0).numpy()
    assert stats.chisquare(counts, DRAWS * softmax(logits[0].numpy())).pvalue > 1e-4


def test_a_masked_action_is_never_drawn_and_has_no_gradient() -> None:
    torch.manual_seed(2)
    logits = torch.randn(DRAWS, 3, requires_grad=True)
    masked = torch.where(torch.tensor([True, False, True]), logits, MASKED_LOGIT)
    drawn = gumbel_softmax(masked, 1.0, gumbel(masked))
    assert not drawn[:, 1].any()
    (drawn * torch.randn(3)).sum().backward()
    assert logits.grad is not None
    assert torch.isfinite(logits.grad).all()
    assert not logits.grad[:, 1].any()
    assert logits.grad[:, [0, 2]].abs().max() > 0


def test_the_smallest_uniform_number_gives_finite_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch, "rand_like", torch.zeros_like)
    assert torch.isfinite(gumbel(torch.zeros(3))).all()


def test_discrete_actions_are_one_hot() -> None:
    pair = critic_actions(spaces.MultiDiscrete([[2], [3]]))
    assert pair.width == 5
    assert pair.encode(torch.tensor([[1, 0], [0, 2]])).tolist() == [[0, 1, 1, 0, 0], [1, 0, 0, 0, 1]]
    single = critic_actions(spaces.Discrete(3, start=7))
    assert single.encode(torch.tensor([2, 0])).tolist() == [[0, 0, 1], [1, 0, 0]]


def test_each_element_is_drawn_from_its_own_logits() -> None:
    pair = critic_actions(spaces.MultiDiscrete([2, 3]))
    certain = torch.tensor([[MASKED_LOGIT, 0.0, MASKED_LOGIT, MASKED_LOGIT, 0.0]], requires_grad=True)
    assert pair.sample(certain, 1.0).tolist() == [[0, 1, 0, 0, 1]]


def test_box_actions_are_clipped_to_the_space() -> None:
    low, high = np.array([0, -np.inf, 2, -np.inf]), np.array([5, np.inf, np.inf, 3])
    box = critic_actions(spaces.Box(low.astype(np.float32), high.astype(np.float32)))
    raw = torch.tensor([[1.5, 40.0, 1.0, 9.0], [-2.0, -40.0, 7.0, -9.0]])
    assert box.encode(raw).tolist() == [[1, 40, 2, 3], [-1, -40, 7, -9]]
    means = torch.tensor([[0.5, -0.5, 2.5, 1.0]], requires_grad=True)
    drawn = box.sample(torch.cat([means, torch.zeros(1, 4)], dim=-1), 1.0)
    assert torch.equal(drawn, means), "deterministic"


SMALL = spaces.Dict({"observation": spaces.Box(-1, 1, (2,), np.float32)})
LARGE = spaces.Dict({"observation": spaces.Discrete(4), "action_mask": spaces.MultiBinary(3)})
BOX, CHOICE = spaces.Box(-1, 1, (2,), np.float32), spaces.Discrete(3)
BATCH = 7


@pytest.mark.parametrize("normalize", [False, True])
def test_a_value_depends_on_all_observations_and_actions(normalize: bool) -> None:
    torch.manual_seed(0)
    critic = Critic([SMALL, LARGE], [BOX, CHOICE], [16], normalize=normalize)
    observations = [
        {"observation": torch.randn(BATCH, 2, requires_grad=True)},
        {"observation": torch.randint(4, (BATCH,)), "action_mask": torch.ones(BATCH, 3)},
    ]
    critic.update_statistics([{name: column.detach() for name, column in parts.items()} for parts in observations])
    done = [torch.randn(BATCH, 2, requires_grad=True), torch.randn(BATCH, 3, requires_grad=True)]
    values = critic(observations, done)
    assert values.shape == (BATCH,)
    values.sum().backward()
    for tensor in (observations[0]["observation"], *done):
        assert tensor.grad is not None
        assert (tensor.grad != 0).any(dim=1).all()
    other = critic([observations[0], {"observation": (observations[1]["observation"] + 1) % 4}], done)
    assert (other != values).all()


def test_statistics_are_kept_only_if_requested() -> None:
    observations = [{"observation": 5 + torch.randn(BATCH, 2)}]
    plain, normalized = (Critic([SMALL], [BOX], [4], normalize=normalize) for normalize in (False, True))
    for critic in (plain, normalized):
        critic.update_statistics(observations)
    assert not list(plain.buffers())
    mean = observations[0]["observation"].mean(0).tolist()
    assert any(buffer.flatten().tolist() == pytest.approx(mean, abs=1e-5) for buffer in normalized.buffers())


OBSERVATION_SPACE = spaces.Dict({"observation": spaces.Box(-1, 1, (3,), np.float32)})
MASK = spaces.Dict({**OBSERVATION_SPACE.spaces, "action_mask": spaces.MultiBinary(3)})
LOW, HIGH = np.array([-2, -np.inf], np.float32), np.array([4, np.inf], np.float32)
ROWS = 50


def actor(action: spaces.Space, observation: spaces.Dict = OBSERVATION_SPACE, **config: Any) -> Actor:
    torch.manual_seed(0)
    policy = Actor(observation_space=observation, action_space=action, model_config={"hidden": [8]} | config)
    with torch.no_grad():
        policy.head.weight.mul_(300)
    return policy


def test_bounded_elements_are_squashed_and_others_are_not() -> None:
    policy = actor(spaces.Box(LOW, HIGH))
    observations = {"observation": torch.randn(ROWS, 3)}
    means, log_deviations = policy._forward({Columns.OBS: observations})[Columns.ACTION_DIST_INPUTS].chunk(2, dim=-1)
    outputs = policy.head_outputs(observations)
    torch.testing.assert_close(means[:, 0], outputs[:, 0].tanh())
    torch.testing.assert_close(means[:, 1], outputs[:, 1])
    assert outputs.abs().max() > 1, "outputs are too small to be squashed"
    torch.testing.assert_close(log_deviations, policy.deviation.log().expand(ROWS, 2))


def test_noise_is_part_of_the_weights_and_has_a_lower_bound() -> None:
    policy, other = actor(spaces.Box(LOW, HIGH)), actor(spaces.Box(LOW, HIGH))
    policy.exploration = 0.2
    other.set_state(policy.get_state())
    assert other.exploration == pytest.approx(0.2)
    policy.exploration = 0.0
    assert policy.exploration == pytest.approx(MIN_DEVIATION)


def test_gradients_pass_through_the_actions() -> None:
    for space, mask in ((spaces.Box(LOW, HIGH), None), (spaces.Discrete(3), [1, 0, 1])):
        policy = actor(space, OBSERVATION_SPACE if mask is None else MASK)
        observations = {"observation": torch.randn(ROWS, 3)}
        if mask is not None:
            observations["action_mask"] = torch.tensor([mask] * ROWS, dtype=torch.int8)
        done, _ = policy.act(observations, temperature=1.0)
        (done * torch.randn(done.shape)).sum().backward()
        assert all(p.grad is not None and torch.isfinite(p.grad).all() for p in policy.parameters())
        assert policy.head.weight.grad is not None
        assert policy.head.weight.grad.abs().sum() > 0


def test_a_masked_action_is_neither_greedy_nor_drawn() -> None:
    policy = actor(spaces.Discrete(3), MASK)
    for forbidden in range(3):
        with torch.no_grad():
            policy.head.bias.copy_(10 * torch.eye(3)[forbidden])
        observations = {"observation": torch.randn(500, 3)} | {"action_mask": torch.ones(500, 3, dtype=torch.int8)}
        assert (policy.head_outputs(observations).argmax(-1) == forbidden).any(), "it is best without the mask"
        observations["action_mask"][:, forbidden] = 0
        logits = policy._forward({Columns.OBS: observations})[Columns.ACTION_DIST_INPUTS]
        assert (logits[:, forbidden] == MASKED_LOGIT).all()
        assert not (policy.distribution.mode(logits) == forbidden).any()
        done, outputs = policy.act(observations, temperature=1.0)
        assert not done[:, forbidden].any()
        assert outputs.abs().max() < 1e6, "regularized outputs are not masked"
