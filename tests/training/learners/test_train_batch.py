"""The bootstrap of each way in which a chunk can end, with values that are known."""

from typing import Any

import numpy as np
import pytest
import torch
from ray.rllib.core.columns import Columns
from ray.rllib.env.single_agent_episode import SingleAgentEpisode
from ray.rllib.env.utils.infinite_lookback_buffer import InfiniteLookbackBuffer
from ray.rllib.evaluation.postprocessing import Postprocessing
from torch import nn

from training.learners.train_batch import TrainBatch

GAMMA = 0.5


class Identity(nn.Module):
    """The value of an observation is the observation."""

    def __init__(self) -> None:
        super().__init__()
        self.unused = nn.Parameter(torch.zeros(1))

    def compute_values(self, batch: dict[str, Any]) -> torch.Tensor:
        return batch[Columns.OBS]["observation"].float()


def chunk(observations: list[float], rewards: list[float], policy: str = "a", **end: bool) -> SingleAgentEpisode:
    n = len(rewards)
    return SingleAgentEpisode(
        module_id=policy,
        agent_id="x",
        len_lookback_buffer=0,
        observations=InfiniteLookbackBuffer({"observation": np.array(observations, np.float32)}),
        infos=InfiniteLookbackBuffer([{}] * (n + 1)),
        actions=InfiniteLookbackBuffer(np.arange(n)),
        rewards=InfiniteLookbackBuffer(np.array(rewards, np.float32)),
        extra_model_outputs={
            Columns.ACTION_LOGP: InfiniteLookbackBuffer(np.zeros(n, np.float32)),
            Columns.ACTION_DIST_INPUTS: InfiniteLookbackBuffer(np.zeros((n, 2), np.float32)),
        },
        **end,
    )


def batch(*chunks: SingleAgentEpisode, lambda_: float = 0.0) -> dict[str, dict[str, Any]]:
    connector = TrainBatch(gamma=GAMMA, lambda_=lambda_)
    return connector(rl_module={"a": Identity(), "b": Identity()}, episodes=list(chunks))


@pytest.mark.parametrize(
    ("end", "target"),
    [({"terminated": True}, 1.0), ({"truncated": True}, 1.0 + GAMMA * 8.0), ({}, 1.0 + GAMMA * 8.0)],
    ids=["terminated", "truncated", "cut"],
)
def test_the_last_value_counts_unless_the_agent_terminated(end: dict[str, bool], target: float) -> None:
    """One-step targets, λ = 0; chunks stand one behind another and do not leak."""
    found = batch(chunk([2.0, 4.0, 8.0], [0.0, 1.0], **end), chunk([16.0, 32.0], [3.0]))["a"]
    targets = found[Postprocessing.VALUE_TARGETS].tolist()
    assert targets == [GAMMA * 4.0, target, 3.0 + GAMMA * 32.0]
    assert found[Columns.OBS]["observation"].tolist() == [2.0, 4.0, 16.0]
    assert found[Columns.ACTIONS].tolist() == [0, 1, 0]


def test_advantages_are_standardised_per_policy() -> None:
    found = batch(
        chunk([0.0, 1.0, 2.0, 3.0], [1.0, -1.0, 5.0], terminated=True),
        chunk([0.0, 1.0, 2.0], [100.0, 0.0], policy="b", truncated=True),
        lambda_=0.9,
    )
    for policy in ("a", "b"):
        advantages = found[policy][Postprocessing.ADVANTAGES].numpy()
        np.testing.assert_allclose([advantages.mean(), advantages.std()], [0.0, 1.0], atol=1e-6)


def test_policies_without_a_transition_are_left_out() -> None:
    assert list(batch(chunk([1.0, 2.0], [0.0]), chunk([1.0], [], policy="b"))) == ["a"]
