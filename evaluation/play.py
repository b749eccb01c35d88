"""The one game loop: games of given contestants in lockstep, actions of each policy batched over all of them.

A game depends on its plan alone. Openings and scripts draw from generators of the game's own, a recurrent policy's
state goes with the agent that it plays, and a policy answers a row whatever the batch around it: so the number of
copies and the company of other games change nothing. That holds for forfeits, too: who has no legal action to give
loses that game there and then, and the others go on.
"""

from __future__ import annotations

import logging
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from numpy.typing import NDArray

from evaluation.asking import Answer, Fault, ask
from evaluation.deadline import Deadline, Expired, watched
from evaluation.match import GamePlan, plan
from evaluation.running import Running, State, contestant_returns, recall
from league.environments.stepping import Batch, BatchedEnvironment, Episode, Turn
from league.errors import EnvironmentMismatch, GameCrashed, GameHung, LeagueError
from league.interface import Interface
from league.policies.policy import Policy
from league.policies.scripted import script
from league.results.records import Forfeit, Game, Match, Reason, Schedule
from league.results.scoring import scores
from league.spaces import DictSpace, Leaf, Space

logger = logging.getLogger(__name__)

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
    deadline: Deadline = Deadline(),  # noqa: B008  frozen
) -> list[Match]:
    """Play the matches at `positions` of a schedule and return them in that order.

    roster: everybody that `schedule.contestants_at` names at those positions. Checkpoints play greedily.
    max_moves: steps of the environment; in one where several agents act at once their actions are one step.
    Raises GameHung, naming the contestants, after `max_moves` steps of one game or when its environment has worked on
    it for longer than the deadline; GameCrashed if its environment raises (both leave an environment that is not to be
    used again); IllegalMask if it allows an agent no action; and EnvironmentMismatch if openings of
    `schedule.opening_plies` steps always end the game.
    """
    positions = list(positions)
    table = _Table(schedule, positions, environment, interface, roster, max_moves, deadline.seconds)
    try:
        with watched(table.look, deadline):
            table.run()
    except Expired as expired:
        raise expired.error from None
    except Exception as error:
        if isinstance(error, LeagueError) or environment.busy is None:
            raise
        raise table.crashed(environment.busy, error) from error
    return [schedule.match(position, table.block(position)) for position in positions]


@dataclass(frozen=True, slots=True)
class _Actor:
    """Who answers the rows of one group."""

    ref: str
    policy: Policy

    def answer(self, batch: Batch, space: Leaf, state: State | None, games: Sequence[Running]) -> Answer:
        """What draws has a generator for each row; checkpoints play greedily. An opening is nobody's to forfeit."""
        if self.ref != OPENING and not self.ref.startswith("script:"):
            return ask(self.policy, batch, space, state, None)
        generators = [game.draws(agent) for game, agent in zip(games, batch.agents, strict=True)]
        if self.ref != OPENING:
            return ask(self.policy, batch, space, state, generators)
        return Answer(self.policy.act(batch.observations, rng=generators).actions, None)


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
        max_seconds: float,
    ) -> None:
        self._environment, self._max_moves, self._max_seconds = environment, max_moves, max_seconds
        self._plies, self._scoring = schedule.opening_plies, schedule.scoring
        self._match_id = schedule.match_id
        self._agents = environment.agents
        self._spaces = [_leaf(interface.agents[agent].action) for agent in environment.agents]
        self._side_of = sides_of(environment.agents, interface)
        self._policy_of = [interface.policies[agent] for agent in environment.agents]
        self._roster = roster
        self._actors = _actors(interface, roster, opening=self._plies > 0)
        self._waiting = (game for position in positions for game in plan(schedule, position))
        self._running: list[Running | None] = [None] * environment.copies
        self._coming: dict[int, Running | None] = {}
        """What each copy has begun last: in a reset, the game that is about to run there."""
        self._remembering: set[Hashable] = set()
        self._finished: dict[int, dict[int, Game]] = {position: {} for position in positions}
        self._told: set[tuple[str, Reason]] = set()

    def run(self) -> None:
        turn = self._environment.start(self._next_episode)
        self._seat(self._coming)
        while turn.batches:
            actions = {group: self._act(group, batch) for group, batch in turn.batches.items()}
            forfeited = self._forfeited()
            if forfeited:
                self._environment.abandon(forfeited)
                actions = _without(turn, actions, forfeited)
            self._end_step()
            turn = self._environment.step(actions)
            self._seat({copy: self._coming[copy] for copy in forfeited})
            self._settle(turn)

    def look(self) -> None:
        """Raise Expired if the environment is at work, and has been on this game for too long."""
        copy = self._environment.busy
        if copy is not None and self._environment.seconds(copy) > self._max_seconds:
            raise Expired(self._hung(copy))

    def block(self, position: int) -> list[Game]:
        """The games at `position` in their order, scored."""
        games = [game for _, game in sorted(self._finished[position].items())]
        forfeits = [{forfeit.contestant for forfeit in game.forfeits} for game in games]
        points = scores([game.returns for game in games], self._scoring, forfeits)
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
        answer = actor.answer(batch, self._spaces[batch.agents[0]], state, games)
        for game, agent, action in zip(games, batch.agents, answer.actions.tolist(), strict=True):
            game.act(agent, action)
        if answer.states is not None:
            self._remembering.add(group)
            for game, agent, own in zip(games, batch.agents, answer.states, strict=True):
                game.states[agent] = own
        for row, fault in answer.faults.items():
            games[row].faults[batch.agents[row]] = fault.reason
            self._tell(actor.ref, fault)
        return answer.actions

    def _tell(self, ref: str, fault: Fault) -> None:
        """Say once why a contestant forfeits: the record has the reason alone."""
        if (ref, fault.reason) not in self._told:
            self._told.add((ref, fault.reason))
            logger.warning("%s forfeits a game (%s): %s", ref, fault.reason, fault.detail)

    def _forfeited(self) -> list[int]:
        """The copies whose games are over, since somebody in them has no action; they are recorded here."""
        copies = [copy for copy, game in enumerate(self._running) if game is not None and game.faults]
        for copy in copies:
            game = self._game(copy)
            self._finished[game.plan.position][game.plan.index] = self._record(game)
            self._running[copy] = None
        return copies

    def crashed(self, copy: int, error: Exception) -> GameCrashed:
        """What is told of an environment that raised."""
        return GameCrashed(f"{self._words(copy)} cannot go on: its environment raised {type(error).__name__}: {error}")

    def _hung(self, copy: int) -> GameHung:
        return GameHung(f"{self._words(copy)} has not ended after {self._max_seconds:g} s of its environment's work")

    def _words(self, copy: int) -> str:
        """`a game of duo@1 and duo@2 (game 0 of match duo-3f/17)`, which is the one that a copy has begun last."""
        game = self._coming[copy]
        assert game is not None, "an idle copy plays no game"
        players = " and ".join(game.plan.contestants)
        return f"a game of {players} (game {game.plan.index} of match {self._match_id(game.plan.position)})"

    def _end_step(self) -> None:
        for copy, game in enumerate(self._running):
            if game is None:
                continue
            if game.end_step(self._plies):
                self._environment.assign(copy, self._groups(game))
            elif game.steps > self._max_moves:
                raise GameHung(f"{self._words(copy)} has not ended after {self._max_moves} moves")
            if self._environment.seconds(copy) > self._max_seconds:
                raise self._hung(copy)

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
        forfeits: dict[int, Forfeit] = {}
        for agent in sorted(game.faults):
            contestant = game.plan.sides[self._side_of[agent]]
            forfeits.setdefault(contestant, Forfeit(contestant, self._agents[agent], game.faults[agent]))
        return Game(
            sides=game.plan.sides,
            seed=game.plan.seed,
            opening=tuple(game.actions[: game.opening]),
            actions=tuple(game.actions[game.opening :]),
            returns=contestant_returns(game.returns, self._side_of, game.plan.sides),
            scores=(),
            forfeits=tuple(forfeits.values()),
        )


def sides_of(agents: Sequence[str], interface: Interface) -> list[int]:
    """The side of each agent, by number."""
    side = {agent: i for i, members in enumerate(interface.sides.values()) for agent in members}
    return [side[agent] for agent in agents]


def _without(turn: Turn, actions: Mapping[Hashable, NDArray], copies: Sequence[int]) -> dict[Hashable, NDArray]:
    """The actions of the rows that are not of these copies."""
    kept = {group: batch.without(copies) for group, batch in turn.batches.items()}
    return {group: actions[group][rows] for group, rows in kept.items() if rows}


def _leaf(space: Space) -> Leaf:
    assert not isinstance(space, DictSpace), "no policy acts in a dictionary"
    return space


def _actors(interface: Interface, roster: Roster, opening: bool) -> dict[Hashable, _Actor]:
    actors: dict[Hashable, _Actor] = {
        (ref, policy_id): _Actor(ref, policy) for ref, agents in roster.items() for policy_id, policy in agents.values()
    }
    for policy_id in interface.policy_ids if opening else ():
        spaces = interface.of_policy(policy_id)
        actors[OPENING, policy_id] = _Actor(OPENING, script("random", spaces.observation, spaces.action))
    return actors
