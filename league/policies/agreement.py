"""Whether two runs of a policy, or two policies, act alike: row by row, ties of the logits apart."""

import numpy as np
from numpy.typing import NDArray

from league.policies.actions import bounds
from league.policies.draws import elements
from league.spaces import Box, MultiDiscrete, Space

NEAR_TIE = 1e-5
"""Two actions whose logits are closer may swap by the order of summation in another runtime."""
ACTION_TOLERANCE = 1e-4
"""Largest difference of a number of an action, relative to the span between its bounds, else to 1 + |x|."""


def same(actions: NDArray, expected: NDArray, space: Space, tolerance: float = ACTION_TOLERANCE) -> NDArray[np.bool_]:
    """(k,): whether each of k actions is the expected one; `tolerance` is for the numbers of a Box."""
    return np.logical_not(np.any(_differs(actions, expected, space, tolerance), axis=1))


def excused(actions: NDArray, expected: NDArray, dist_inputs: NDArray, space: Space) -> NDArray[np.bool_]:
    """(k,): whether each action is the expected one, or differs only where the best two logits are within NEAR_TIE.

    dist_inputs: (k, d) inputs of the distribution that one of the two was taken from.
    """
    differs = _differs(actions, expected, space, ACTION_TOLERANCE)
    if isinstance(space, Box):
        return np.logical_not(np.any(differs, axis=1))
    parts = elements(dist_inputs, space) if isinstance(space, MultiDiscrete) else [dist_inputs]
    margins = np.stack([_margin(logits) for logits in parts], axis=1)
    return np.logical_not(np.any(differs & (margins >= NEAR_TIE), axis=1))


def _differs(actions: NDArray, expected: NDArray, space: Space, tolerance: float) -> NDArray[np.bool_]:
    """(k, numbers of an action)"""
    if isinstance(space, Box):
        low, high = bounds(space)
        span = np.where(np.isfinite(low) & np.isfinite(high), high - low, 1 + np.abs(expected))
        differs = ~(np.abs(actions - expected) <= tolerance * span)
    else:
        differs = actions != expected
    return differs.reshape(len(actions), -1)


def _margin(logits: NDArray) -> NDArray:
    """How far the best logit is above the second, per row; infinite where there is but one action."""
    if logits.shape[-1] < 2:
        return np.full(len(logits), np.inf)
    ordered = np.sort(logits, axis=-1)
    return ordered[:, -1] - ordered[:, -2]
