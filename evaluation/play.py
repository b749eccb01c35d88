"""The one game loop: games of given contestants in lockstep, actions of each policy batched over all of them.

A game depends on its plan alone. Openings and scripts draw from generators of the game's own, a recurrent policy's
state goes with the agent that it plays, and a policy answers a row whatever the batch around it: so the number of
copies and the company of other games change nothing.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from evaluation.match import GamePlan, plan
from evaluation.running import Running, contestant_returns, recall
from league.environments.legality import check_actions
from league.environments.stepping import Batch, BatchedEnvironment, Episode, Turn
from league.errors import EnvironmentMismatch, GameHung, IllegalAction
from league.interface import Interface
from league.policies.policy import Policy
from league.policies.scripted import script
from league.results.records import Game, Match, Schedule
from league.results.scoring import scores

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
    max_moves: steps of the environment; in one where several agents act at once their actions are one step.
    Raises IllegalAction naming the contestant, GameHung after `max_moves` steps of one game, and
    EnvironmentMismatch if openings of `schedule.opening_plies` steps always end the game.
    """
    positions = list(positions)
    table = _Table(schedule, positions, environment, interface, roster, max_moves)
    table.run()
    return [schedule.match(position, table.block(position)) for position in positions]


@dataclass(frozen=True, slots=True)
class _Actor:
    """Who answers the rows of one group."""

    ref: str
    policy: Policy

    def generators(self, games: Sequence[Running], agents: Sequence[int]) -> list[np.random.Generator] | None:
        """One per row for what draws; None for checkpoints, which play greedily."""
        if self.ref != OPENING and not self.ref.startswith("script:"):
            return None
        return [game.draws(agent) for game, agent in zip(games, agents, strict=True)]


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
        self._environment, self._interface, self._max_moves = environment, interface, max_moves
        self._plies, self._scoring = schedule.opening_plies, schedule.scoring
        self._agents = environment.agents
        self._side_of = sides_of(environment.agents, interface)
        self._policy_of = [interface.policies[agent] for agent in environment.agents]
        self._roster = roster
        self._actors = _actors(interface, roster, opening=self._plies > 0)
        self._waiting = (game for position in positions for game in plan(schedule, position))
        self._running: list[Running | None] = [None] * environment.copies
        self._coming: dict[int, Running | None] = {}
        self._remembering: set[Hashable] = set()
        self._finished: dict[int, dict[int, Game]] = {position: {} for position in positions}

    def run(self) -> None:
        turn = self._environment.start(self._next_episode)
        self._seat(self._coming)
        while turn.batches:
            actions = {group: self._act(group, batch) for group, batch in turn.batches.items()}
            self._end_step()
            try:
                turn = self._environment.step(actions)
            except IllegalAction as error:
                raise self._blame(turn, actions, error) from error
            self._settle(turn)

    def block(self, position: int) -> list[Game]:
        """The games at `position` in their order, scored."""
        games = [game for _, game in sorted(self._finished[position].items())]
        points = scores([game.returns for game in games], self._scoring)
        return [replace(game, scores=own) for game, own in zip(games, points, strict=True)]

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
        return Episode(game.plan.seed, self._groups(game))

    def _fresh(self, game: GamePlan, attempt: int) -> Running:
        return Running(game, [0.0] * len(self._agents), attempt, opening=None if self._plies else 0)

    def _redraw(self, ended: Running) -> Running:
        if ended.attempt + 1 == MAX_OPENINGS:
            raise EnvironmentMismatch(
                f"play.opening_plies: {MAX_OPENINGS} openings of {self._plies} random steps all ended the game;"
                " fewer are needed"
            )
        return self._fresh(ended.plan, ended.attempt + 1)

    def _in_opening(self, game: Running) -> bool:
        """Whether no contestant has moved: a game that ends then says nothing about them."""
        return 0 < self._plies >= game.steps

    def _groups(self, game: Running) -> list[Hashable]:
        if game.opening is None:
            return [(OPENING, policy) for policy in self._policy_of]
        seats = (game.plan.contestants[game.plan.sides[side]] for side in self._side_of)
        return [(ref, self._roster[ref][agent][0]) for ref, agent in zip(seats, self._agents, strict=True)]

    def _act(self, group: Hashable, batch: Batch) -> NDArray:
        actor = self._actors[group]
        games = [self._game(copy) for copy in batch.copies]
        for game, agent, reward in zip(games, batch.agents, batch.rewards, strict=True):
            game.returns[agent] += reward
        state = None
        if group in self._remembering:
            state = recall([game.states.get(agent) for game, agent in zip(games, batch.agents, strict=True)])
        answer = actor.policy.act(batch.observations, state=state, rng=actor.generators(games, batch.agents))
        for game, agent, action in zip(games, batch.agents, answer.actions.tolist(), strict=True):
            game.act(agent, action)
        if answer.state is not None:
            self._remembering.add(group)
            for row, (game, agent) in enumerate(zip(games, batch.agents, strict=True)):
                game.states[agent] = {name: array[row] for name, array in answer.state.items()}
        return answer.actions

    def _end_step(self) -> None:
        for copy, game in enumerate(self._running):
            if game is None:
                continue
            if game.end_step(self._plies):
                self._environment.assign(copy, self._groups(game))
            elif game.steps > self._max_moves:
                players = " and ".join(game.plan.contestants)
                raise GameHung(f"a game of {players} has not ended after {self._max_moves} moves")

    def _settle(self, turn: Turn) -> None:
        for ending in turn.endings:
            self._game(ending.copy).returns[ending.agent] += ending.reward
        for copy in turn.finished:
            game = self._game(copy)
            if not self._in_opening(game):
                self._finished[game.plan.position][game.plan.index] = self._record(game)
        self._seat({copy: self._coming[copy] for copy in turn.finished})

    def _seat(self, games: Mapping[int, Running | None]) -> None:
        for copy, game in games.items():
            self._running[copy] = game

    def _game(self, copy: int) -> Running:
        game = self._running[copy]
        assert game is not None, "an idle copy does not act"
        return game

    def _record(self, game: Running) -> Game:
        return Game(
            sides=game.plan.sides,
            seed=game.plan.seed,
            opening=tuple(game.actions[: game.opening]),
            actions=tuple(game.actions[game.opening :]),
            returns=contestant_returns(game.returns, self._side_of, game.plan.sides),
            scores=(),
        )

    def _blame(self, turn: Turn, actions: Mapping[Hashable, NDArray], error: IllegalAction) -> IllegalAction:
        """The same error with the name of the contestant whose action it was."""
        for group, batch in turn.batches.items():
            space = self._interface.agents[self._agents[batch.agents[0]]].action
            try:
                check_actions(batch, actions[group], space, self._agents)
            except IllegalAction:
                return IllegalAction(f"{self._actors[group].ref}: {error}")
        return error


def sides_of(agents: Sequence[str], interface: Interface) -> list[int]:
    """The side of each agent, by number."""
    side = {agent: i for i, members in enumerate(interface.sides.values()) for agent in members}
    return [side[agent] for agent in agents]


def _actors(interface: Interface, roster: Roster, opening: bool) -> dict[Hashable, _Actor]:
    actors: dict[Hashable, _Actor] = {
        (ref, policy_id): _Actor(ref, policy) for ref, agents in roster.items() for policy_id, policy in agents.values()
    }
    for policy_id in interface.policy_ids if opening else ():
        spaces = interface.of_policy(policy_id)
        actors[OPENING, policy_id] = _Actor(OPENING, script("random", spaces.observation, spaces.action))
    return actors
