"""State of a game in progress: actions, returns, recurrent states and random generators of its agents."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from statistics import mean
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evaluation.schedules.builders import GamePlan
from league.results.records import Reason

State = dict[str, NDArray]
"""name of a recurrent input → array"""


@dataclass(slots=True)
class RunningGame:
    """A game in one of the parallel environments.

    returns: of each agent so far. opening: number of `actions` that belong to the opening, None while it lasts.
    faults: agent → why it has no playable action in the current step.
    """

    plan: GamePlan
    returns: list[float]
    attempt: int = 0
    steps: int = 0
    opening: int | None = None
    actions: list[Any] = field(default_factory=list)
    states: dict[int, State] = field(default_factory=dict)
    faults: dict[int, Reason] = field(default_factory=dict)
    _moves: list[tuple[int, Any]] = field(default_factory=list)
    _draws: dict[int, np.random.Generator] = field(default_factory=dict)

    def draws(self, agent: int) -> np.random.Generator:
        """Random generator of an agent's policy, or of the opening while it lasts."""
        if agent not in self._draws:
            plan = self.plan
            self._draws[agent] = plan.policy(agent) if self.opening is not None else plan.opening(self.attempt, agent)
        return self._draws[agent]

    def act(self, agent: int, action: Any) -> None:
        """Record an agent's action in the current step."""
        self._moves.append((agent, action))

    def end_step(self, plies: int) -> bool:
        """End the step after all agents have acted. Returns whether it was the last one of an opening of `plies`."""
        if len(self._moves) > 1:
            # Agents are batched by policy across games, so their order in batches is arbitrary.
            self._moves.sort(key=_agent)
        self.actions += [action for _, action in self._moves]
        self._moves.clear()
        self.steps += 1
        if self.steps != plies:
            return False
        self.opening = len(self.actions)
        self._draws.clear()
        return True


def stack_states(kept: Sequence[State | None]) -> State | None:
    """Recurrent state of a batch's rows (k, …). None if no row has one, which a policy treats as the start of an
       episode.

    Rows that start next to others get zeros, the initial state of a graph.
    """
    known = next((state for state in kept if state is not None), None)
    if known is None:
        return None
    start = {name: np.zeros_like(array) for name, array in known.items()}
    return {name: np.stack([(state or start)[name] for state in kept]) for name in known}


def contestant_returns(
    returns: Sequence[float], side_of: Sequence[int], sides: Sequence[int], contestants: int = 2
) -> tuple[float | None, ...]:
    """Return of each contestant: the mean over the agents of a side, then over its sides; None without sides.

    returns, side_of: of each agent. sides: the contestant of each side.
    Means are rounded once (`statistics.mean` adds fractions), so that sides with equal returns tie exactly.
    """
    of_side: list[list[float]] = [[] for _ in sides]
    for value, side in zip(returns, side_of, strict=True):
        of_side[side].append(value)
    own: list[list[float]] = [[] for _ in range(contestants)]
    for values, contestant in zip(of_side, sides, strict=True):
        own[contestant].append(_mean(values))
    return tuple(_mean(values) if values else None for values in own)


def _mean(values: Sequence[float]) -> float:
    return values[0] if len(values) == 1 else float(mean(values))


def _agent(move: tuple[int, Any]) -> int:
    return move[0]
