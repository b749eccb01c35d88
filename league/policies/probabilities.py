"""How likely each action is, from the inputs of the action distribution: see league/policies/actions.py."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from league.errors import ConfigError
from league.policies.actions import bounds
from league.policies.draws import elements
from league.spaces import Box, Discrete, MultiDiscrete, Space


def probabilities(dist_inputs: NDArray, space: Space, mask: NDArray | None = None) -> list[Any]:
    """One entry for each row of `dist_inputs` (k, d).

    Discrete       the probability of each action, from `start` on; they add up to 1
    MultiDiscrete  such a list for each element
    Box            `mean` and `std`, each in the space's shape and units, before the action is clipped to its bounds

    mask: (k, n) for a policy that has one; what it forbids has the probability 0.
    Raises ConfigError for an action space that no policy can have.
    """
    match space:
        case Discrete():
            return _shares(dist_inputs, mask).tolist()
        case MultiDiscrete():
            masks = [None] * int(np.size(space.nvec)) if mask is None else elements(mask, space)
            parts = [_shares(part, own) for part, own in zip(elements(dist_inputs, space), masks, strict=True)]
            return [[part[row].tolist() for part in parts] for row in range(len(dist_inputs))]
        case Box(shape=shape):
            means, deviations = _gaussian(dist_inputs.astype(np.float64), space)
            pairs = zip(means.reshape(-1, *shape), deviations.reshape(-1, *shape), strict=True)
            return [{"mean": mean.tolist(), "std": deviation.tolist()} for mean, deviation in pairs]
    raise ConfigError(f"no policy has actions of {space!r}")


def _shares(logits: NDArray, mask: NDArray | None) -> NDArray:
    """Softmax, (k, n) float64."""
    if mask is not None:
        logits = np.where(mask != 0, logits, -np.inf)
    weights = np.exp(logits - logits.max(axis=1, keepdims=True), dtype=np.float64)
    return weights / weights.sum(axis=1, keepdims=True)


def _gaussian(dist_inputs: NDArray, space: Box) -> tuple[NDArray, NDArray]:
    """Means and deviations (k, m), in the units of the space: as `to_environment` spans its bounds."""
    means, log_deviations = np.split(dist_inputs, 2, axis=1)
    deviations = np.exp(log_deviations)
    low, high = (np.ravel(bound) for bound in bounds(space))
    finite = np.isfinite(low) & np.isfinite(high)
    low, high = np.where(finite, low, -1.0), np.where(finite, high, 1.0)
    half, centre = high / 2 - low / 2, high / 2 + low / 2
    return centre + means * half, deviations * half
