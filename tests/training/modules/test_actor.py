from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from ray.rllib.core.columns import Columns

from training.modules.acting import MASKED
from training.modules.actor import SMALLEST_DEVIATION, Actor

SEEN = spaces.Dict({"observation": spaces.Box(-1, 1, (3,), np.float32)})
MASK = spaces.Dict({**SEEN.spaces, "action_mask": spaces.MultiBinary(3)})
LOW, HIGH = np.array([-2, -np.inf], np.float32), np.array([4, np.inf], np.float32)
ROWS = 50


def actor(action: spaces.Space, observation: spaces.Dict = SEEN, **config: Any) -> Actor:
    torch.manual_seed(0)
    made = Actor(observation_space=observation, action_space=action, model_config={"hidden": [8]} | config)
    with torch.no_grad():
        made.head.weight.mul_(300)
    return made


def seen(rows: int = ROWS) -> dict[str, torch.Tensor]:
    return {"observation": torch.randn(rows, 3)}


def test_elements_with_two_bounds_are_squashed_and_others_are_not() -> None:
    made = actor(spaces.Box(LOW, HIGH))
    observations = seen()
    means, log_deviations = made._forward({Columns.OBS: observations})[Columns.ACTION_DIST_INPUTS].chunk(2, dim=-1)
    answers = made.answers(observations)
    assert torch.equal(means[:, 0], answers[:, 0].tanh())
    assert torch.equal(means[:, 1], answers[:, 1])
    assert answers.abs().max() > 1, "else nothing would show"
    assert torch.equal(log_deviations, made.deviation.log().expand(ROWS, 2))


def test_noise_is_part_of_the_weights_and_never_without_a_logarithm() -> None:
    made, other = actor(spaces.Box(LOW, HIGH)), actor(spaces.Box(LOW, HIGH))
    made.exploration = 0.2
    other.set_state(made.get_state())
    assert other.exploration == pytest.approx(0.2)
    made.exploration = 0.0
    assert made.exploration == pytest.approx(SMALLEST_DEVIATION)


def test_gradients_pass_to_the_answers_through_what_is_done() -> None:
    for space, mask in ((spaces.Box(LOW, HIGH), None), (spaces.Discrete(3), [1, 0, 1])):
        made = actor(space, SEEN if mask is None else MASK)
        observations = seen()
        if mask is not None:
            observations["action_mask"] = torch.tensor([mask] * ROWS, dtype=torch.int8)
        done, _ = made.act(observations, temperature=1.0)
        (done * torch.randn(done.shape)).sum().backward()
        assert all(p.grad is not None and torch.isfinite(p.grad).all() for p in made.parameters())
        assert made.head.weight.grad is not None
        assert made.head.weight.grad.abs().sum() > 0


def test_a_masked_choice_is_neither_the_greedy_nor_a_drawn_one() -> None:
    made = actor(spaces.Discrete(3), MASK)
    for forbidden in range(3):
        with torch.no_grad():
            made.head.bias.copy_(10 * torch.eye(3)[forbidden])
        observations = seen(500) | {"action_mask": torch.ones(500, 3, dtype=torch.int8)}
        assert (made.answers(observations).argmax(-1) == forbidden).any(), "it would be chosen without the mask"
        observations["action_mask"][:, forbidden] = 0
        logits = made._forward({Columns.OBS: observations})[Columns.ACTION_DIST_INPUTS]
        assert (logits[:, forbidden] == MASKED).all()
        assert not (made.distribution.mode(logits) == forbidden).any()
        done, answers = made.act(observations, temperature=1.0)
        assert not done[:, forbidden].any()
        assert answers.abs().max() < 1e6, "what is regularised, no mask has touched"
