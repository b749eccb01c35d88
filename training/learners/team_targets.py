"""Targets of a team's value, pure: agents that leave and arrive, masks apart, truncation apart from termination."""

from dataclasses import dataclass

import torch
from torch import Tensor

from training.learners.q_targets import returns
from training.modules.mixer import Mixer


@dataclass(frozen=True, slots=True)
class TeamSteps:
    """k joint transitions of a team of n agents. together: it has one value, learned from the mean of its agents'
    rewards; else each agent has its own.

    rewards, present, terminated: (k, n). discounts: (k,), γ^m of m steps. states, next_states: (k, s).
    """

    rewards: Tensor
    present: Tensor
    terminated: Tensor
    discounts: Tensor
    states: Tensor
    next_states: Tensor
    together: bool

    def mixed(self, mixer: Mixer, values: Tensor) -> Tensor:
        """(k, m) of the values (k, n) of what was done: 0 in the mixture for who was not there."""
        return mixer(torch.where(self.present, values, 0.0), self.states)

    def counted(self) -> Tensor:
        """(k, m) bool: where somebody was there."""
        return self.present.any(-1, keepdim=True) if self.together else self.present

    def targets(self, mixer: Mixer, following: Tensor) -> Tensor:
        """(k, m), R + γ^m Q_tot(s', u'), from the values (k, n) of what is best next.

        For who has terminated nothing follows: 0 in the mixture, and nothing at all where nobody goes on. Who was
        truncated could have gone on, and counts by its last observation.
        """
        goes_on = self.present & ~self.terminated
        paid, ended = self.rewards, ~goes_on
        if self.together:
            paid, ended = paid.mean(-1, keepdim=True), ended.all(-1, keepdim=True)
        later = mixer(torch.where(goes_on, following, 0.0), self.next_states)
        return returns(paid, self.discounts.unsqueeze(-1), ended, later)
