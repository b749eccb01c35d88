"""Random legal actions for many agents at once, and random play of vectorised environments."""

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from league.environments.vector.vector_env import AgentRows
from league.spaces import ACTION_MASK, Box, Discrete, MultiBinary, MultiDiscrete, Space
from league.spaces.arrays import bounds

AT_A_BOUND = 0.1
"""Share of the elements of a bounded Box that are drawn at a bound."""


def random_actions(space: Space, count: int, mask: NDArray | None, rng: np.random.Generator) -> NDArray:
    """Draw `count` actions from `space`, (count, …). mask: (count, n), or None if all actions are legal."""
    match space:
        case Discrete():
            indices = rng.integers(space.n, size=count) if mask is None else random_choices(mask, rng)
            return (space.start + indices).astype(space.dtype)
        case MultiDiscrete():
            choices = np.asarray(space.nvec).ravel()
            allowed = np.ones((count, choices.sum()), dtype=np.int8) if mask is None else mask
            parts = np.split(allowed, np.cumsum(choices)[:-1], axis=1)
            indices = np.stack([random_choices(part, rng) for part in parts], axis=1)
            return (np.asarray(space.start) + indices.reshape(count, *space.shape)).astype(space.dtype)
        case MultiBinary():
            return rng.integers(2, size=(count, *space.shape)).astype(space.dtype)
        case Box(dtype=dtype) if np.dtype(dtype).kind != "f":
            low, high = (np.array(bound, dtype) for bound in (space.low, space.high))
            return rng.integers(low, high, (count, *space.shape), dtype, endpoint=True)
        case Box():
            low, high = bounds(space)
            bounded = np.isfinite(low) & np.isfinite(high)
            share = rng.random((count, *space.shape))
            # A weighted mean of the bounds: `high - low` may overflow.
            drawn = np.where(bounded, low, 0) * (1 - share) + np.where(bounded, high, 0) * share
            at_bound = np.where(rng.random(drawn.shape) < 0.5, low, high)
            drawn = np.where(rng.random(drawn.shape) < AT_A_BOUND, at_bound, drawn)
            near = np.clip(rng.normal(size=drawn.shape), low, high)
            return np.where(bounded, drawn, near).astype(space.dtype)
    raise TypeError(f"random actions of a {type(space).__name__} are not supported")


def legal_actions(rows: Sequence[AgentRows], actions: Sequence[Space], rng: np.random.Generator) -> NDArray:
    """Draw legal actions for all rows that must act, in the order of `VectorEnv.step`. actions: space of each agent."""
    drawn, places = [], []
    for block in acting_rows(rows):
        mask = block.observations.get(ACTION_MASK)
        for agent in np.unique(block.agents).tolist():
            indices = np.flatnonzero(block.agents == agent)
            drawn.append(random_actions(actions[agent], len(indices), None if mask is None else mask[indices], rng))
            places.append(block.envs[indices] * len(actions) + agent)
    return np.concatenate(drawn)[np.argsort(np.concatenate(places), kind="stable")]


def random_steps(
    step: Callable[[NDArray[np.int64], NDArray], Sequence[AgentRows]],
    rows: Sequence[AgentRows],
    actions: Sequence[Space],
    rng: np.random.Generator,
    most: int,
) -> Iterator[Sequence[AgentRows]]:
    """Step all copies in which an agent must act, until there is none, and yield the rows of each step.

    Args:
        step: As of VectorEnv.
        rows: The newest rows of the copies.
        actions: Action space of each agent.
        rng: Draws the actions.
        most: Maximum number of steps.
    """
    for _ in range(most):
        if not len(copies := acting(rows)):
            return
        rows = step(copies, legal_actions(rows, actions, rng))
        yield rows


def acting(rows: Sequence[AgentRows]) -> NDArray[np.int64]:
    """Return the copies in which an agent must act, ascending."""
    return np.unique(np.concatenate([np.zeros(0, dtype=np.int64), *(block.envs[~block.has_ended] for block in rows)]))


def acting_rows(rows: Sequence[AgentRows], copies: NDArray[np.int64] | None = None) -> list[AgentRows]:
    """Return the rows of agents that must act, in some copies or in all, without empty blocks."""
    masks = [~block.has_ended & (copies is None or np.isin(block.envs, copies)) for block in rows]
    return [block.take(np.flatnonzero(mask)) for block, mask in zip(rows, masks, strict=True) if mask.any()]


def random_choices(mask: NDArray, rng: np.random.Generator) -> NDArray[np.int64]:
    """Choose one of the nonzero columns of each row, all with the same probability, (k,). mask: (k, n)."""
    allowed = np.cumsum(mask != 0, axis=1, dtype=np.int32)
    choice = (rng.random(len(mask)) * allowed[:, -1]).astype(np.int32)
    return (allowed > choice[:, np.newaxis]).argmax(axis=1)
