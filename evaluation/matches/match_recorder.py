"""Records games while they are played, their actions in columns, and turns them into Match records."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evaluation.matches.policy_calls import PolicyFault
from evaluation.matches.seating import returns_of_games
from evaluation.schedules.builders import GamePlans
from league.environments.stepping import Indices
from league.results.records import GAMES_PER_BLOCK, Forfeit, Game, Match, Members, Schedule
from league.results.scoring import scores

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


class MatchRecorder:
    """Collects the actions, forfeits and results of the games of some matches.

    An episode is an attempt at a game. Each game has one recorded episode; those that ended in their opening are not
    recorded.
    """

    def __init__(
        self,
        schedule: Schedule,
        plans: GamePlans,
        agents: Sequence[str],
        side_of: Sequence[int],
        members: Sequence[Members],
    ) -> None:
        self._schedule, self._plans, self._members = schedule, plans, members
        self._agents, self._side_of = agents, side_of
        self.actions = ActionLog()
        self._faults: defaultdict[int, dict[int, PolicyFault]] = defaultdict(dict)
        self._ended: list[tuple[Indices, Indices, NDArray[np.float64], Indices]] = []

    def add_fault(self, game: int, agent: int, fault: PolicyFault) -> None:
        """A game ends because an agent has no playable action."""
        self._faults[game][agent] = fault

    def end(self, games: Indices, episodes: Indices, returns: NDArray[np.float64], steps: Indices) -> None:
        """Record k ended games. returns: of the agents, (k, agents). steps: those that count, (k,)."""
        self._ended.append((games, episodes, returns, steps))

    def matches(self) -> list[Match]:
        """Return the matches, in the order of their games."""
        if not self._ended:
            return []
        games, episodes, returns, steps = (np.concatenate(column) for column in zip(*self._ended, strict=True))
        order = np.argsort(games)
        plans, schedule = self._plans, self._schedule
        sides, seeds = list(map(tuple, plans.sides.tolist())), plans.seeds.tolist()
        actions = self.actions.of(episodes[order], steps[order], schedule.opening_plies)
        values = returns_of_games(returns[order], self._side_of, plans.sides)
        forfeits = [self._forfeits(game) if game in self._faults else () for game in range(len(plans))]
        matches = []
        for first in range(0, len(plans), GAMES_PER_BLOCK):
            block = range(first, first + GAMES_PER_BLOCK)
            losers = [{forfeit.contestant for forfeit in forfeits[game]} for game in block]
            points = scores([values[game] for game in block], schedule.scoring, losers)
            records = [
                Game(
                    sides[game],
                    seeds[game],
                    *actions[game],
                    values[game],
                    game_scores,
                    forfeits[game],
                    self._members[game],
                )
                for game, game_scores in zip(block, points, strict=True)
            ]
            matches.append(schedule.match(int(plans.positions[first]), records, seeds[first]))
        return matches

    def _forfeits(self, game: int) -> tuple[Forfeit, ...]:
        forfeits: dict[int, Forfeit] = {}
        for agent, fault in sorted(self._faults[game].items()):
            contestant = int(self._plans.sides[game, self._side_of[agent]])
            forfeits.setdefault(contestant, Forfeit(contestant, self._agents[agent], fault.reason, fault.detail))
        return tuple(forfeits.values())
