"""The one game loop: games of given contestants in lockstep, actions of each policy batched over all of them.

A game depends on its plan alone. Openings and scripts draw from generators of the game's own, and a policy
answers a row whatever the batch around it, so the number of copies and the company of other games change
nothing.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evaluation.match import GamePlan, plan, scores
from league.environments.stepping import Batch, BatchedEnvironment, Episode, Turn
from league.errors import EnvironmentMismatch, GameHung, IllegalAction
from league.interface import Interface
from league.policies.policy import Policy
from league.policies.scripted import script
from league.results.records import Game, Match, Schedule
from league.spaces import ACTION_MASK

Roster = Mapping[str, Mapping[str, tuple[str, Policy]]]
"""reference → agent → (policy id, policy)"""

OPENING = "opening"
"""In place of a reference in a group (reference, policy id): the moves before the contestants take over."""

MAX_OPENINGS = 1000
"""Attempts at an opening that does not end the game."""


def play(
    schedule: Schedule,
    positions: Iterable[int],
    environment: BatchedEnvironment,
    interface: Interface,
    roster: Roster,
    max_moves: int = 10_000,
) -> list[Match]:
    """Play the matches at `positions` of a schedule and return them in that order.

    roster: everybody that `schedule.contestants_at` names at those positions. Checkpoints play greedily.
    Raises IllegalAction naming the contestant, GameHung after `max_moves` actions of one game, and
    EnvironmentMismatch if openings of `schedule.opening_plies` moves always end the game.
    """
    positions = list(positions)
    table = _Table(schedule, positions, environment, interface, roster, max_moves)
    table.run()
    return [schedule.match(position, table.finished[position]) for position in positions]


@dataclass(slots=True)
class _Running:
    """A game in progress on one copy."""

    plan: GamePlan
    returns: list[float]
    attempt: int = 0
    actions: list[Any] = field(default_factory=list)
    opening: np.random.Generator | None = None
    generators: dict[int, np.random.Generator] = field(default_factory=dict)

    def generator(self, side: int) -> np.random.Generator:
        if side not in self.generators:
            self.generators[side] = self.plan.policy(side)
        return self.generators[side]


@dataclass(frozen=True, slots=True)
class _Actor:
    """Who answers the rows of one group."""

    ref: str
    policy: Policy

    def generators(self, games: Sequence[_Running], sides: Sequence[int]) -> list[np.random.Generator] | None:
        """One per row for what draws; None for checkpoints, which play greedily."""
        if self.ref == OPENING:
            return [game.opening for game in games if game.opening is not None]
        if not self.ref.startswith("script:"):
            return None
        return [game.generator(side) for game, side in zip(games, sides, strict=True)]


class _Table:
    """Where the games are played: which copy plays which game, and who answers for whom."""

    def __init__(
        self,
        schedule: Schedule,
        positions: Sequence[int],
        environment: BatchedEnvironment,
        interface: Interface,
        roster: Roster,
        max_moves: int,
    ) -> None:
        self._environment, self._max_moves = environment, max_moves
        self._plies = schedule.opening_plies
        self._agents = environment.agents
        self._side_of = sides_of(environment.agents, interface)
        self._policy_of = [interface.policies[agent] for agent in environment.agents]
        self._roster = roster
        self._actors = _actors(interface, roster)
        self._waiting = (game for position in positions for game in plan(schedule, position))
        self._running: list[_Running | None] = [None] * environment.copies
        self._coming: dict[int, _Running | None] = {}
        self.finished: dict[int, list[Game]] = {position: [] for position in positions}

    def run(self) -> None:
        turn = self._environment.start(self._next_episode)
        self._seat(self._coming)
        while turn.batches:
            actions = {group: self._act(group, batch) for group, batch in turn.batches.items()}
            try:
                turn = self._environment.step(actions)
            except IllegalAction as error:
                raise self._blame(turn, actions, error) from error
            self._settle(turn)
        for games in self.finished.values():
            games.sort(key=_rotation_of)

    def _next_episode(self, copy: int) -> Episode | None:
        ended = self._running[copy]
        if ended is not None and self._in_opening(ended):
            game = self._redraw(ended)
        else:
            waiting = next(self._waiting, None)
            if waiting is None:
                self._coming[copy] = None
                return None
            game = self._fresh(waiting, 0)
        self._coming[copy] = game
        return Episode(game.plan.seed, self._groups(game, opening=self._plies > 0))

    def _fresh(self, game: GamePlan, attempt: int) -> _Running:
        opening = game.opening(attempt) if self._plies else None
        return _Running(game, [0.0] * len(self._agents), attempt, opening=opening)

    def _redraw(self, ended: _Running) -> _Running:
        if ended.attempt + 1 == MAX_OPENINGS:
            raise EnvironmentMismatch(
                f"play.opening_plies: {MAX_OPENINGS} openings of {self._plies} random moves all ended the game;"
                " fewer are needed"
            )
        return self._fresh(ended.plan, ended.attempt + 1)

    def _in_opening(self, game: _Running) -> bool:
        """Whether no contestant has moved: a game that ends then says nothing about them."""
        return 0 < self._plies >= len(game.actions)

    def _groups(self, game: _Running, opening: bool) -> list[Hashable]:
        if opening:
            return [(OPENING, policy) for policy in self._policy_of]
        seats = (game.plan.contestants[game.plan.sides[side]] for side in self._side_of)
        return [(ref, self._roster[ref][agent][0]) for ref, agent in zip(seats, self._agents, strict=True)]

    def _act(self, group: Hashable, batch: Batch) -> NDArray:
        actor = self._actors[group]
        games = [self._game(copy) for copy in batch.copies]
        for game, agent, reward in zip(games, batch.agents, batch.rewards, strict=True):
            game.returns[agent] += reward
        sides = [self._side_of[agent] for agent in batch.agents]
        answer = actor.policy.act(batch.observations, rng=actor.generators(games, sides))
        if answer.state is not None:
            raise EnvironmentMismatch(f"{actor.ref} has a recurrent policy, and matches carry no state")
        for copy, game, action in zip(batch.copies, games, answer.actions.tolist(), strict=True):
            game.actions.append(action)
            if len(game.actions) == self._plies:
                self._environment.assign(copy, self._groups(game, opening=False))
            elif len(game.actions) > self._max_moves:
                players = " and ".join(game.plan.contestants)
                raise GameHung(f"a game of {players} has not ended after {self._max_moves} moves")
        return answer.actions

    def _settle(self, turn: Turn) -> None:
        for ending in turn.endings:
            self._game(ending.copy).returns[ending.agent] += ending.reward
        for copy in turn.finished:
            game = self._game(copy)
            if not self._in_opening(game):
                self.finished[game.plan.position].append(self._record(game))
        self._seat({copy: self._coming[copy] for copy in turn.finished})

    def _seat(self, games: Mapping[int, _Running | None]) -> None:
        for copy, game in games.items():
            self._running[copy] = game

    def _game(self, copy: int) -> _Running:
        game = self._running[copy]
        assert game is not None, "an idle copy does not act"
        return game

    def _record(self, game: _Running) -> Game:
        returns = contestant_returns(game.returns, self._side_of, game.plan.sides)
        return Game(
            sides=game.plan.sides,
            seed=game.plan.seed,
            opening=tuple(game.actions[: self._plies]),
            actions=tuple(game.actions[self._plies :]),
            returns=returns,
            scores=scores(returns),
        )

    def _blame(self, turn: Turn, actions: Mapping[Hashable, NDArray], error: IllegalAction) -> IllegalAction:
        """The same error with the name of the contestant whose action it was."""
        for group, batch in turn.batches.items():
            mask = batch.observations.get(ACTION_MASK)
            if mask is not None and not _legal(actions[group], mask):
                return IllegalAction(f"{self._actors[group].ref}: {error}")
        return error


def contestant_returns(returns: Sequence[float], side_of: Sequence[int], sides: Sequence[int]) -> tuple[float, ...]:
    """Mean return of each contestant over the agents of the side that it played."""
    per_side: list[list[float]] = [[] for _ in sides]
    for value, side in zip(returns, side_of, strict=True):
        per_side[side].append(value)
    of_contestant = {contestant: per_side[side] for side, contestant in enumerate(sides)}
    return tuple(sum(of_contestant[c]) / len(of_contestant[c]) for c in range(len(sides)))


def sides_of(agents: Sequence[str], interface: Interface) -> list[int]:
    """The side of each agent, by number."""
    side = {agent: i for i, members in enumerate(interface.sides.values()) for agent in members}
    return [side[agent] for agent in agents]


def _actors(interface: Interface, roster: Roster) -> dict[Hashable, _Actor]:
    actors: dict[Hashable, _Actor] = {
        (ref, policy_id): _Actor(ref, policy) for ref, agents in roster.items() for policy_id, policy in agents.values()
    }
    for policy_id in interface.policy_ids:
        spaces = interface.of_policy(policy_id)
        actors[OPENING, policy_id] = _Actor(OPENING, script("random", spaces.observation, spaces.action))
    return actors


def _legal(actions: NDArray, mask: NDArray) -> bool:
    inside = (actions >= 0) & (actions < mask.shape[1])
    return bool((inside & (mask[np.arange(len(mask)), np.where(inside, actions, 0)] != 0)).all())


def _rotation_of(game: Game) -> int:
    """The place of a game in its block: contestant 0 sits one side further in each."""
    return game.sides.index(0)
