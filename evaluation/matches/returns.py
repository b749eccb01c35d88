"""The sides of agents, and the returns of contestants from those of the agents on their sides."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import mean

import numpy as np
from numpy.typing import NDArray

from league.interface import Interface

Returns = tuple[float | None, ...]
"""The return of each contestant; None for one that did not take part."""


def agent_sides(agents: Sequence[str], interface: Interface) -> list[int]:
    """The number of each agent's side."""
    side = {agent: i for i, members in enumerate(interface.sides.values()) for agent in members}
    return [side[agent] for agent in agents]


def contestant_returns(
    returns: Sequence[float], side_of: Sequence[int], sides: Sequence[int], contestants: int = 2
) -> Returns:
    """Return of each contestant: the mean over the agents of a side, then over its sides; None without sides.

    returns, side_of: of each agent. sides: the contestant of each side.
    Means are rounded once (`statistics.mean` adds fractions), so that sides with equal returns tie exactly.
    """
    of_side: list[list[float]] = [[] for _ in sides]
    for value, side in zip(returns, side_of, strict=True):
        of_side[side].append(value)
    of_contestant: list[list[float]] = [[] for _ in range(contestants)]
    for values, contestant in zip(of_side, sides, strict=True):
        of_contestant[contestant].append(_mean(values))
    return tuple(_mean(values) if values else None for values in of_contestant)


def returns_of_games(returns: NDArray[np.float64], side_of: Sequence[int], sides: NDArray[np.int64]) -> list[Returns]:
    """Return `contestant_returns` of each game. returns: (games, agents). sides: (games, sides)."""
    if sorted(side_of) == [0, 1]:
        # Two agents on two sides: no means.
        of_contestant = np.argsort(np.asarray(sides)[:, side_of], axis=1)
        return list(map(tuple, np.take_along_axis(returns, of_contestant, axis=1).tolist()))
    return [
        contestant_returns(agent_returns, side_of, seating)
        for agent_returns, seating in zip(returns.tolist(), sides.tolist(), strict=True)
    ]


def _mean(values: Sequence[float]) -> float:
    return values[0] if len(values) == 1 else float(mean(values))
