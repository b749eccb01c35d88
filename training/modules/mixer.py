"""Mixers: from the values of a team's agents to the value of the team. Only learning sees them.

A mixer is increasing in each agent's value: what is best for each agent by its own value is then best for the team,
argmax_u Q_tot = (argmax_u1 Q_1, …, argmax_un Q_n), so that agents can act alone (equations 4 and 5 of the QMIX paper).
"""

from typing import Protocol

import torch
from torch import Tensor, nn

from training.modules.normalization import RunningNormalization


class Mixer(Protocol):
    """values (B, n) of a team's n agents, 0 of one that is not there, and states (B, s) → (B, m): one value for the
    team, or one for each agent."""

    def __call__(self, values: Tensor, states: Tensor) -> Tensor: ...


class MonotonicMixer(nn.Module):
    """Rashid et al., 2018, "QMIX: monotonic value function factorisation for deep multi-agent reinforcement learning",
    arXiv 1803.11485, section 4.1:

        Q_tot = |W₂(s)|ᵀ elu(|W₁(s)|ᵀ Q + b₁(s)) + b₂(s),

    where W₁ (n × width), b₁, W₂ (width) are linear in the state s, and b₂ has a hidden layer with ReLU.
    """

    def __init__(self, agents: int, state_size: int, width: int, normalize: bool = False) -> None:
        """normalize: shift and scale each number of the state by its running mean and deviation."""
        super().__init__()
        self.agents, self.width = agents, width
        self.normalization = RunningNormalization((state_size,)) if normalize else None
        self.first_weights = nn.Linear(state_size, agents * width)
        self.first_bias = nn.Linear(state_size, width)
        self.second_weights = nn.Linear(state_size, width)
        self.second_bias = nn.Sequential(nn.Linear(state_size, width), nn.ReLU(), nn.Linear(width, 1))

    def forward(self, values: Tensor, states: Tensor) -> Tensor:
        """(B, n) and (B, s) → (B, 1)."""
        if self.normalization is not None:
            states = self.normalization(states)
        weights = self.first_weights(states).abs().unflatten(-1, (self.agents, self.width))
        hidden = torch.einsum("bn,bnw->bw", values, weights) + self.first_bias(states)
        mixed = (nn.functional.elu(hidden) * self.second_weights(states).abs()).sum(-1, keepdim=True)
        return mixed + self.second_bias(states)

    def update_statistics(self, states: Tensor) -> None:
        """Take a batch into the running statistics of the state, where they are kept."""
        if self.normalization is not None:
            self.normalization.update(states)


def summed(values: Tensor, states: Tensor) -> Tensor:  # noqa: ARG001  # as every mixer
    """Sunehag et al., 2017, "Value-decomposition networks for cooperative multi-agent learning", arXiv 1706.05296:
    Q_tot = Σ Q_i."""
    return values.sum(-1, keepdim=True)


def unmixed(values: Tensor, states: Tensor) -> Tensor:  # noqa: ARG001
    """Each agent by itself: independent Q-learning (Tan, 1993)."""
    return values
