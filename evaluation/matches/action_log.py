"""The actions of all games, in columns."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from league.environments.stepping import Indices

Actions = tuple[Any, ...]


class ActionLog:
    """Collects actions of many episodes step by step, and returns those of each episode."""

    def __init__(self) -> None:
        self._places: list[tuple[Indices, Indices, Indices]] = []
        self._actions: list[Any] = []

    def add(self, episodes: Indices, steps: Indices, agents: Indices, actions: NDArray) -> None:
        """Add one action each of k agents. steps: of the episodes, from 0."""
        self._places.append((episodes, steps, agents))
        self._actions += actions.tolist()

    def of(self, episodes: Indices, steps: Indices, opening: int) -> list[tuple[Actions, Actions]]:
        """Return the actions of m episodes: those of the first `opening` steps, and the others.

        They are ordered by step, then by agent. steps: how many steps of each episode count, (m,).
        """
        if not self._places:
            return [((), ())] * len(episodes)
        owners, at, agents = (np.concatenate(column) for column in zip(*self._places, strict=True))
        # An episode and a step in one number, which grows with both.
        stride = int(at.max()) + 1
        order = np.lexsort((agents, owners * stride + at))
        places = (owners * stride + at)[order]
        actions = [self._actions[i] for i in order.tolist()]
        firsts, middles, ends = (
            np.searchsorted(places, episodes * stride + np.minimum(step, stride)).tolist()
            for step in (np.zeros_like(steps), np.minimum(steps, opening), steps)
        )
        return [
            (tuple(actions[first:middle]), tuple(actions[middle:end]))
            for first, middle, end in zip(firsts, middles, ends, strict=True)
        ]
