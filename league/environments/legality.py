"""Whether a batch of actions is legal: in its space, and allowed by its mask. Checked before anything has moved."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from league.environments.stepping import Batch
from league.errors import IllegalAction
from league.spaces import ACTION_MASK, Box, Discrete, MultiBinary, MultiDiscrete, Space

ROUNDING = 1e-5
"""Of an action at a bound of its Box, relative to the bound."""


def check_actions(batch: Batch, actions: NDArray, space: Space, agents: Sequence[str]) -> None:
    """Raise IllegalAction, naming agent and action, unless actions (k, …) fit `space` and the rows' masks."""
    rows = len(batch.copies)
    if len(actions) != rows:
        raise IllegalAction(f"{len(actions)} actions for {rows} agents that must act")
    if isinstance(space, Discrete | Box | MultiDiscrete | MultiBinary) and actions.shape[1:] != space.shape:
        expected = list(space.shape)
        raise IllegalAction(
            f"actions of {agents[batch.agents[0]]} have shape {list(actions.shape[1:])}, not {expected}"
        )
    mask = batch.observations.get(ACTION_MASK)
    legal = legal_rows(actions, space, mask)
    if not legal.all():
        row = int(np.argmin(legal))
        raise IllegalAction(
            f"action {actions[row].tolist()} of {agents[batch.agents[row]]} is illegal"
            + ("" if mask is None else f": action_mask is {mask[row].tolist()}")
        )


def legal_rows(actions: NDArray, space: Space, mask: NDArray | None) -> NDArray:
    """Which of the actions (k, …) are in `space` and allowed by their rows of the mask: (k,) bool."""
    match space:
        case Discrete():
            chosen = actions - space.start
            legal = (chosen >= 0) & (chosen < space.n)
            if mask is not None:
                legal &= mask[np.arange(len(mask)), np.where(legal, chosen, 0)] != 0
            return legal
        case MultiDiscrete():
            choices = np.asarray(space.nvec).ravel()
            chosen = (actions - np.asarray(space.start)).reshape(len(actions), -1)
            inside = (chosen >= 0) & (chosen < choices)
            if mask is not None:
                # One after another, the choices of the elements.
                first = np.cumsum(choices) - choices
                inside &= mask[np.arange(len(mask))[:, np.newaxis], first + np.where(inside, chosen, 0)] != 0
            return inside.all(axis=1)
        case Box():
            low, high = _bound(space.low, -np.inf), _bound(space.high, np.inf)
            inside = (actions >= low - ROUNDING * (1 + np.abs(low))) & (actions <= high + ROUNDING * (1 + np.abs(high)))
            return (inside & np.isfinite(actions)).reshape(len(actions), -1).all(axis=1)
        case MultiBinary():
            return ((actions == 0) | (actions == 1)).reshape(len(actions), -1).all(axis=1)
    return np.ones(len(actions), dtype=bool)


def allows_nothing(mask: NDArray, space: Space) -> NDArray:
    """Which rows of a mask (k, n) leave no legal action, in one element of it at least: (k,) bool."""
    if not isinstance(space, MultiDiscrete):
        return ~(mask != 0).any(axis=1)
    choices = np.asarray(space.nvec).ravel()
    return (np.add.reduceat(mask != 0, np.cumsum(choices) - choices, axis=1, dtype=int) == 0).any(axis=1)


def _bound(bound: Any, infinite: float) -> NDArray:
    values = np.array(bound, dtype=np.float64)
    return np.where(np.isnan(values), infinite, values)
