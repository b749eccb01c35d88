"""Targets of Q-learning, pure: with masks, n-step returns, and truncation apart from termination."""

import torch
from torch import Tensor

from training.modules.acting import MASKED


def best_legal(values: Tensor, mask: Tensor | None) -> Tensor:
    """(B, n) values → (B,) the best action that the mask (B, n) allows. Where it allows none, as in some environments'
    last observations, it says nothing about what could have been done, and all count."""
    if mask is None:
        return values.argmax(-1)
    allowed = mask.bool()
    allowed = allowed | ~allowed.any(-1, keepdim=True)
    return torch.where(allowed, values, MASKED).argmax(-1)


def next_actions(online: Tensor | None, target: Tensor, mask: Tensor | None) -> Tensor:
    """(B,) the actions whose target values are bootstrapped from: the network that learns chooses them in double
    Q-learning (van Hasselt, Guez and Silver, 2016, arXiv 1509.06461, equation 4), else the target network does
    (online: None)."""
    return best_legal(target if online is None else online, mask)


def returns(rewards: Tensor, discounts: Tensor, terminated: Tensor, next_values: Tensor) -> Tensor:
    """R + γ^m V(s_{t+m}), where nothing follows after termination, and what follows after truncation counts.

    All (B,): sums of the m discounted rewards, γ^m, flags of the last step, values of the observation after it.
    """
    return rewards + discounts * torch.where(terminated, 0.0, next_values)


def projected(probabilities: Tensor, atoms: Tensor, rewards: Tensor, discounts: Tensor, terminated: Tensor) -> Tensor:
    """The distribution of R + γ^m Z on the atoms of Z: Bellemare, Dabney and Munos, 2017, arXiv 1707.06887,
    algorithm 1. probabilities (B, atoms) of the chosen next actions; others (B,). Returns (B, atoms).

    The mass of a return between two atoms is divided among both, the nearer one having more; beyond the outermost ones
    it is theirs.
    """
    count = len(atoms)
    low, high = atoms[0], atoms[-1]
    moved = returns(rewards.unsqueeze(1), discounts.unsqueeze(1), terminated.unsqueeze(1), atoms.unsqueeze(0))
    places = (moved.clamp(low, high) - low) / (high - low) * (count - 1)
    # Share of an atom's mass that another one gets: 1 at its own place, falling to 0 at its neighbours'.
    numbers = torch.arange(count, device=atoms.device, dtype=places.dtype)
    shares = (1 - (places.unsqueeze(1) - numbers.view(1, -1, 1)).abs()).clamp(min=0)
    return (shares * probabilities.unsqueeze(1)).sum(-1)
