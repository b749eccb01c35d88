"""The game loop: plays games in parallel environments, with the actions of each policy batched over all games.

A game depends on its plan alone. Openings and scripts use random generators of the game, recurrent states belong to
agents, and a policy's output for a row does not depend on its batch. The number of parallel environments and the other
games therefore do not change a result. This includes forfeits: a contestant without a legal action loses that game
immediately, and the other games continue.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evaluation.matches.game_state import ActionLog, AgentStates, RunningGame, State, contestant_returns
from evaluation.matches.policy_calls import Generators, PolicyFault, PolicyOutput, call_policy
from evaluation.matches.watchdog import Deadline, GameTimeout, enforce_deadline
from evaluation.schedules.builders import GamePlan, game_plans
from league.environments.stepping import Batch, BatchedEnvironment, Indices, Starts, Turn
from league.errors import EnvironmentMismatch, GameCrashed, GameHung, LeagueError, one_line
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
"""Stands for the reference in a group (reference, policy id) during random opening moves."""

NO_GAME = -1
MAX_OPENINGS = 1000
"""Attempts at an opening that does not end the game."""


def play_matches(
    schedule: Schedule,
    positions: Iterable[int],
    environment: BatchedEnvironment,
    interface: Interface,
    roster: Roster,
    max_moves: int = 10_000,
    deadline: Deadline = Deadline(),  # noqa: B008  frozen
) -> list[Match]:
    """Play the matches at `positions` of a schedule and return them in that order.

    Args:
        schedule: The schedule.
        positions: Positions of matches in it.
        environment: Parallel environments to play in.
        interface: Interface of the league.
        roster: All contestants of these matches. Checkpoints play greedily.
        max_moves: Maximum environment steps of a game. Simultaneous actions are one step.
        deadline: Time limit of a game.

    Raises:
        GameHung: A game exceeded `max_moves` or the deadline. The environment must not be used again.
        GameCrashed: The environment raised. It must not be used again.
        IllegalMask: The environment allows an agent no action.
        EnvironmentMismatch: Openings of `schedule.opening_plies` steps always end the game.
    """
    positions = list(positions)
    loop = _GameLoop(schedule, positions, environment, interface, roster, max_moves, deadline.seconds)
    try:
        with enforce_deadline(loop.check_deadline, deadline):
            loop.run()
    except GameTimeout as expired:
        raise expired.error from None
    except Exception as error:
        if isinstance(error, LeagueError) or not len(environment.busy):
            raise
        raise loop.crashed(int(environment.busy[0]), error) from error
    blocks = loop.blocks()
    return [schedule.match(position, blocks[position]) for position in positions]


@dataclass(frozen=True, slots=True)
class _PolicyCaller:
    """The policy that acts for the rows of one group."""

    ref: str
    policy: Policy

    @property
    def draws(self) -> bool:
        """Whether the policy gets one generator per row; checkpoints play greedily."""
        return self.ref == OPENING or self.ref.startswith("script:")

    def answer(self, batch: Batch, space: Leaf, state: State | None, generators: Generators | None) -> PolicyOutput:
        """Call the policy on a batch. Openings cannot be forfeited."""
        if self.ref == OPENING:
            return PolicyOutput(self.policy.act(batch.observations, rng=generators).actions, None)
        return call_policy(self.policy, batch, space, state, generators)


@dataclass(frozen=True, slots=True)
class _EndedGame:
    """A recorded game. number: of the game in the action log. returns: of the agents. steps: those that count."""

    number: int
    game: RunningGame
    returns: list[float]
    steps: int


class _GameLoop:
    """Assigns games to parallel environments and policies to agents.

    Games are numbered in the order of their starts, including those that end in their opening and are replaced.
    """

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
        self._agents, self._side_of = environment.agents, agent_sides(environment.agents, interface)
        self._spaces = [_leaf(interface.agents[agent].action) for agent in self._agents]
        callers = _callers(interface, roster, opening=self._plies > 0)
        self._callers = list(callers.values())
        self._seating = _Seating(list(callers), interface, roster, self._agents, self._side_of)
        self._positions = tuple(positions)
        self._waiting = (game for position in positions for game in game_plans(schedule, position))
        num_envs = environment.num_envs
        self._games: list[RunningGame] = []
        # Of each environment: the number of its game, and that of the game that it began last.
        self._running, self._begun = np.full(num_envs, NO_GAME), np.full(num_envs, NO_GAME)
        self._steps = np.zeros(num_envs, np.int64)
        self._returns = np.zeros((num_envs, len(self._agents)))
        self._states: dict[int, AgentStates] = {}
        self._log = ActionLog()
        self._ended: list[_EndedGame] = []
        self._faulty: set[int] = set()
        self._logged: set[tuple[str, Reason]] = set()

    def run(self) -> None:
        turn = self._environment.start(self._next_episodes)
        self._begin(np.arange(len(self._running)))
        while turn.batches:
            actions = {group: self._act(group, batch) for group, batch in turn.batches.items()}
            forfeited = self._forfeited()
            if len(forfeited):
                self._environment.abandon(forfeited)
                actions = _without(turn, actions, forfeited)
            self._end_step()
            turn = self._environment.step(actions)
            self._settle(turn)
            self._begin(np.concatenate([forfeited, turn.finished]))

    def check_deadline(self) -> None:
        """Raise GameTimeout if an environment has worked on its current game for too long."""
        busy = self._environment.busy
        if len(slow := busy[self._environment.seconds()[busy] > self._max_seconds]):
            raise GameTimeout(self._hung(slow))

    def blocks(self) -> dict[int, list[Game]]:
        """Position → its scored games, in order."""
        actions = self._log.by_game({ended.number: ended.steps for ended in self._ended}, self._plies)
        games: dict[int, dict[int, Game]] = {position: {} for position in self._positions}
        for ended in self._ended:
            plan = ended.game.plan
            games[plan.position][plan.index] = self._record(ended, *actions[ended.number])
        return {position: self._scored([own[index] for index in sorted(own)]) for position, own in games.items()}

    def _scored(self, games: Sequence[Game]) -> list[Game]:
        forfeits = [{forfeit.contestant for forfeit in game.forfeits} for game in games]
        points = scores([game.returns for game in games], self._scoring, forfeits)
        return [replace(game, scores=own) for game, own in zip(games, points, strict=True)]

    def _next_episodes(self, envs: Indices) -> Starts:
        starting: list[tuple[int, RunningGame]] = []
        for env in envs.tolist():
            game = self._next_game(env)
            self._begun[env] = NO_GAME if game is None else len(self._games)
            if game is not None:
                self._games.append(game)
                starting.append((env, game))
        return Starts(
            np.array([env for env, _ in starting], dtype=np.int64),
            np.array([game.plan.seed for _, game in starting]),
            self._groups([game for _, game in starting], in_opening=self._plies > 0),
        )

    def _next_game(self, env: int) -> RunningGame | None:
        if self._running[env] != NO_GAME and self._in_opening(env):
            return self._redraw(self._game(env))
        plan = next(self._waiting, None)
        return None if plan is None else RunningGame(plan)

    def _redraw(self, ended: RunningGame) -> RunningGame:
        if ended.attempt + 1 == MAX_OPENINGS:
            raise EnvironmentMismatch(
                f"play.opening_plies: {MAX_OPENINGS} openings of {self._plies} random steps all ended the game;"
                " fewer are needed"
            )
        return RunningGame(ended.plan, ended.attempt + 1)

    def _in_opening(self, env: int) -> bool:
        """Whether a game is in its opening. A game that ends there is replaced."""
        return 0 < self._plies >= int(self._steps[env])

    def _groups(self, games: Sequence[RunningGame], in_opening: bool) -> Indices:
        """Groups of all agents in some games, (games, agents)."""
        return np.array(
            [self._seating.opening if in_opening else self._seating.groups(game.plan) for game in games], dtype=np.int64
        ).reshape(len(games), len(self._agents))

    def _begin(self, envs: Indices) -> None:
        """The episodes that these environments began last are their current games now."""
        self._running[envs] = self._begun[envs]
        self._steps[envs] = 0
        self._returns[envs] = 0.0
        for states in self._states.values():
            states.forget(envs)

    def _act(self, group: int, batch: Batch) -> NDArray:
        caller = self._callers[group]
        self._returns[batch.envs, batch.agents] += batch.rewards
        state = self._states[group].get(batch) if group in self._states else None
        generators = self._generators(batch) if caller.draws else None
        answer = caller.answer(batch, self._spaces[batch.agents[0]], state, generators)
        self._log.add(self._running[batch.envs], self._steps[batch.envs], batch.agents, answer.actions)
        if answer.states is not None:
            if group not in self._states:
                self._states[group] = AgentStates(*self._returns.shape)
            self._states[group].update(batch, answer.states)
        for row, fault in answer.faults.items():
            env, agent = int(batch.envs[row]), int(batch.agents[row])
            self._game(env).faults[agent] = fault.reason
            self._faulty.add(env)
            self._log_forfeit(caller.ref, fault)
        return answer.actions

    def _generators(self, batch: Batch) -> list[np.random.Generator]:
        games, in_opening = self._running[batch.envs].tolist(), (self._steps[batch.envs] < self._plies).tolist()
        return [
            self._games[game].generator(agent, opens)
            for game, agent, opens in zip(games, batch.agents.tolist(), in_opening, strict=True)
        ]

    def _log_forfeit(self, ref: str, fault: PolicyFault) -> None:
        """Log the details of a forfeit once. The record contains only the reason."""
        if (ref, fault.reason) not in self._logged:
            self._logged.add((ref, fault.reason))
            logger.warning("%s forfeits a game (%s): %s", ref, fault.reason, fault.detail)

    def _forfeited(self) -> Indices:
        """Record games that end by forfeit and return their environments."""
        envs = np.array(sorted(self._faulty), dtype=np.int64)
        self._faulty.clear()
        self._end(envs)
        self._running[envs] = NO_GAME
        return envs

    def _end(self, envs: Indices) -> None:
        """Record the games in some environments."""
        numbers, steps = self._running[envs].tolist(), self._steps[envs].tolist()
        for number, returns, played in zip(numbers, self._returns[envs].tolist(), steps, strict=True):
            self._ended.append(_EndedGame(number, self._games[number], returns, played))

    def crashed(self, env: int, error: Exception) -> GameCrashed:
        """The error for an environment that raised."""
        return GameCrashed(
            f"{self._describe(env)} cannot continue: its environment raised {one_line(error, with_type=True)}"
        )

    def _hung(self, envs: Indices) -> GameHung:
        """The error for games of which one hangs."""
        others = f", or one of {len(envs) - 1} others that are stepped with it," if len(envs) > 1 else ""
        return GameHung(
            f"{self._describe(int(envs[0]))}{others} has not ended after {self._max_seconds:g} s of environment time"
        )

    def _describe(self, env: int) -> str:
        """`a game of duo@1 and duo@2 (game 0 of match duo-3f/17)` for the last game that an environment began."""
        plan = self._games[self._begun[env]].plan
        players = " and ".join(plan.contestants)
        return f"a game of {players} (game {plan.index} of match {self._match_id(plan.position)})"

    def _end_step(self) -> None:
        playing = np.flatnonzero(self._running != NO_GAME)
        self._steps[playing] += 1
        steps = self._steps[playing]
        if len(opened := playing[steps == self._plies]) and self._plies:
            games = [self._game(env) for env in opened.tolist()]
            self._environment.assign(opened, self._groups(games, in_opening=False))
        if len(endless := playing[steps > self._max_moves]):
            raise GameHung(f"{self._describe(int(endless[0]))} has not ended after {self._max_moves} moves")
        if len(slow := playing[self._environment.seconds()[playing] > self._max_seconds]):
            raise self._hung(slow[:1])

    def _settle(self, turn: Turn) -> None:
        for rows in turn.endings:
            self._returns[rows.envs, rows.agents] += rows.rewards
        finished = turn.finished
        self._end(finished[self._steps[finished] > self._plies] if self._plies else finished)

    def _game(self, env: int) -> RunningGame:
        return self._games[self._running[env]]

    def _record(self, ended: _EndedGame, opening: tuple[Any, ...], actions: tuple[Any, ...]) -> Game:
        plan, faults = ended.game.plan, ended.game.faults
        forfeits: dict[int, Forfeit] = {}
        for agent in sorted(faults):
            contestant = plan.sides[self._side_of[agent]]
            forfeits.setdefault(contestant, Forfeit(contestant, self._agents[agent], faults[agent]))
        return Game(
            sides=plan.sides,
            seed=plan.seed,
            opening=opening,
            actions=actions,
            returns=contestant_returns(ended.returns, self._side_of, plan.sides),
            scores=(),
            forfeits=tuple(forfeits.values()),
        )


class _Seating:
    """The groups of agents: numbers of the policies that act for them, given as (reference, policy id)."""

    def __init__(
        self,
        groups: Sequence[tuple[str, str]],
        interface: Interface,
        roster: Roster,
        agents: Sequence[str],
        side_of: Sequence[int],
    ) -> None:
        number = {group: i for i, group in enumerate(groups)}
        self._side_of = side_of
        self._of_ref = {ref: [number[ref, policies[agent][0]] for agent in agents] for ref, policies in roster.items()}
        self.opening = [number.get((OPENING, interface.policies[agent]), 0) for agent in agents]

    def groups(self, plan: GamePlan) -> list[int]:
        """Return the group of each agent in a game after its opening."""
        refs = [self._of_ref[plan.contestants[contestant]] for contestant in plan.sides]
        return [refs[side][agent] for agent, side in enumerate(self._side_of)]


def agent_sides(agents: Sequence[str], interface: Interface) -> list[int]:
    """The number of each agent's side."""
    side = {agent: i for i, members in enumerate(interface.sides.values()) for agent in members}
    return [side[agent] for agent in agents]


def _without(turn: Turn, actions: Mapping[int, NDArray], envs: Indices) -> dict[int, NDArray]:
    """The actions of all rows that do not belong to these environments."""
    kept = {group: batch.without(envs) for group, batch in turn.batches.items()}
    return {group: actions[group][rows] for group, rows in kept.items() if len(rows)}


def _leaf(space: Space) -> Leaf:
    assert not isinstance(space, DictSpace), "action spaces are not dictionaries"
    return space


def _callers(interface: Interface, roster: Roster, opening: bool) -> dict[tuple[str, str], _PolicyCaller]:
    actors: dict[tuple[str, str], _PolicyCaller] = {
        (ref, policy_id): _PolicyCaller(ref, policy)
        for ref, agents in roster.items()
        for policy_id, policy in agents.values()
    }
    for policy_id in interface.policy_ids if opening else ():
        spaces = interface.of_policy(policy_id)
        actors[OPENING, policy_id] = _PolicyCaller(OPENING, script("random", spaces.observation, spaces.action))
    return actors
