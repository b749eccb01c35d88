"""State of games in progress: generators, recurrent states, recorded actions; and the returns of contestants."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from statistics import mean
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evaluation.schedules.builders import GamePlan
from league.environments.stepping import Batch, Indices
from league.results.records import Reason

State = dict[str, NDArray]
"""name of a recurrent input → array (k, …)"""


@dataclass(slots=True)
class RunningGame:
    """A game in one of the parallel environments, or one that has ended.

    attempt: number of earlier openings that ended the game. faults: agent → why it has no playable action in the
    current step.
    """

    plan: GamePlan
    attempt: int = 0
    faults: dict[int, Reason] = field(default_factory=dict)
    _generators: dict[tuple[bool, int], np.random.Generator] = field(default_factory=dict)

    def generator(self, agent: int, in_opening: bool) -> np.random.Generator:
        """Random generator of an agent's policy, or of its opening moves."""
        key = in_opening, agent
        if key not in self._generators:
            plan = self.plan
            self._generators[key] = plan.opening(self.attempt, agent) if in_opening else plan.policy(agent)
        return self._generators[key]


class ActionLog:
    """The actions of all games, in columns."""

    def __init__(self) -> None:
        self._places: list[tuple[Indices, Indices, Indices]] = []
        self._actions: list[Any] = []

    def add(self, games: Indices, steps: Indices, agents: Indices, actions: NDArray) -> None:
        """Add one action each of k agents. games: numbers of their games. steps: in the games, from 0."""
        self._places.append((games, steps, agents))
        self._actions += actions.tolist()

    def by_game(self, steps: Mapping[int, int], opening: int) -> dict[int, tuple[tuple[Any, ...], tuple[Any, ...]]]:
        """Return the actions of some games: those of the first `opening` steps, and the others.

        They are ordered by step, then by agent. steps: number of a game → how many of its steps count.
        """
        if not self._places:
            return dict.fromkeys(steps, ((), ()))
        games, at, agents = (np.concatenate(column) for column in zip(*self._places, strict=True))
        order = np.lexsort((agents, at, games))
        games, at = games[order], at[order]
        actions = [self._actions[i] for i in order.tolist()]
        numbers = np.array(list(steps), dtype=np.int64)
        firsts, lasts = np.searchsorted(games, numbers), np.searchsorted(games, numbers, "right")
        found = {}
        for game, first, last in zip(steps, firsts.tolist(), lasts.tolist(), strict=True):
            own = at[first:last]
            middle = first + int(np.searchsorted(own, opening))
            stop = first + int(np.searchsorted(own, steps[game]))
            found[game] = tuple(actions[first:middle]), tuple(actions[middle:stop])
        return found


class AgentStates:
    """Recurrent states of the agents that one policy controls, by environment and agent.

    Agents without a state get zeros, the initial state of a graph, if they act together with others that have one.
    """

    def __init__(self, num_envs: int, agents: int) -> None:
        self._shape = num_envs, agents
        self._known = np.zeros(self._shape, dtype=bool)
        self._kept: State = {}

    def get(self, batch: Batch) -> State | None:
        """The states before the step of a batch's rows. None if no row has one, which a policy treats as the start of
        an episode.
        """
        if not self._known[batch.envs, batch.agents].any():
            return None
        return {name: kept[batch.envs, batch.agents] for name, kept in self._kept.items()}

    def update(self, batch: Batch, after: State) -> None:
        """Store the states after the step of a batch's rows."""
        for name, values in after.items():
            if name not in self._kept:
                self._kept[name] = np.zeros((*self._shape, *values.shape[1:]), values.dtype)
            self._kept[name][batch.envs, batch.agents] = values
        self._known[batch.envs, batch.agents] = True

    def forget(self, envs: Indices) -> None:
        """The games in `envs` are over."""
        self._known[envs] = False
        for kept in self._kept.values():
            kept[envs] = 0


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
