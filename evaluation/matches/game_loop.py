"""The game loop: plays games in parallel environments, with the actions of each policy batched over all games.

A game depends on its plan alone. Openings, scripts and sampled actions use random numbers of the game, recurrent states
belong to agents, and a policy's output for a row does not depend on its batch. The number of parallel environments and
the other games therefore do not change a result. This includes forfeits: a contestant without a legal action loses that
game immediately, and the other games continue.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from evaluation.matches.game_state import ActionNumbers, AgentGenerators, AgentStates, action_keys
from evaluation.matches.match_recorder import MatchRecorder
from evaluation.matches.openings import OpeningMoves
from evaluation.matches.policy_calls import Randomness, call_policy
from evaluation.matches.seating import NO_MIXTURES, ActingVersions, Roster, Seating, acting_versions, agent_sides
from evaluation.matches.watchdog import Deadline, GameTimeout, enforce_deadline
from evaluation.schedules.builders import GamePlans, game_plans
from league.environments.stepping import Batch, BatchedEnvironment, Indices, Starts, Turn
from league.errors import EnvironmentMismatch, GameCrashed, GameHung, LeagueError, one_line
from league.interface import Interface
from league.policies.policy import Policy
from league.registry.storage.manifest import Mixture
from league.results.records import Match, Reason, Schedule
from league.spaces import DictSpace, Leaf, Space

logger = logging.getLogger(__name__)

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
    mixtures: Mapping[str, Mixture] = NO_MIXTURES,
) -> list[Match]:
    """Play the matches at `positions` of a schedule and return them in that order.

    Args:
        schedule: The schedule.
        positions: Positions of matches in it.
        environment: Parallel environments to play in.
        interface: Interface of the league.
        roster: All contestants of these matches, with the members in place of mixtures. Versions select actions as
            `schedule.actions` says.
        max_moves: Maximum environment steps of a game. Simultaneous actions are one step.
        deadline: Time limit of a game.
        mixtures: Contestant → its members, for contestants that are mixtures.

    Raises:
        GameHung: A game exceeded `max_moves` or the deadline. The environment must not be used again.
        GameCrashed: The environment raised. It must not be used again.
        IllegalMask: The environment allows an agent no action.
        EnvironmentMismatch: Openings of `schedule.opening_plies` steps always end the game.
    """
    plans = game_plans(schedule, list(positions))
    acting = acting_versions(schedule, plans, mixtures)
    loop = _GameLoop(schedule, plans, acting, environment, interface, roster, max_moves, deadline.seconds)
    try:
        with enforce_deadline(loop.check_deadline, deadline):
            loop.run()
    except GameTimeout as expired:
        raise expired.error from None
    except Exception as error:
        if isinstance(error, LeagueError) or not len(environment.busy):
            raise
        raise loop.crashed(environment.busy, error) from error
    return loop.recorder.matches()


class _GameLoop:
    """Assigns games to parallel environments and policies to agents.

    A game is a row of `plans`. An episode is an attempt at a game: one that ends in its opening is replaced. Episodes
    are numbered in the order of their starts.
    """

    def __init__(
        self,
        schedule: Schedule,
        plans: GamePlans,
        acting: ActingVersions,
        environment: BatchedEnvironment,
        interface: Interface,
        roster: Roster,
        max_moves: int,
        max_seconds: float,
    ) -> None:
        self._schedule, self._plans, self._environment = schedule, plans, environment
        self._max_moves, self._max_seconds, self._plies = max_moves, max_seconds, schedule.opening_plies
        self._agents, side_of = environment.agents, agent_sides(environment.agents, interface)
        self._spaces = [_leaf(interface.agents[agent].action) for agent in self._agents]
        self._seating = Seating(schedule, plans, interface, roster, self._agents, side_of, acting)
        self.recorder = MatchRecorder(schedule, plans, self._agents, side_of, acting.members)
        self._next_game = 0
        # Of each episode: its game, and the number of earlier attempts at it.
        self._games, self._attempts = np.zeros(0, np.int64), np.zeros(0, np.int64)
        num_envs = environment.num_envs
        shape = num_envs, len(self._agents)
        # Of each environment: its episode, and the one that it began last.
        self._running, self._begun = np.full(num_envs, NO_GAME), np.full(num_envs, NO_GAME)
        self._steps, self._returns = np.zeros(num_envs, np.int64), np.zeros(shape)
        self._openings = OpeningMoves(interface, len(self._agents), plans.seeds, self._plies)
        self._generators = AgentGenerators(*shape)
        self._states: dict[int, AgentStates] = {}
        self._faulty: set[int] = set()
        # Of each environment: whether its simulator lost its game, which is repeated; whether its next game was chosen.
        self._is_lost, self._is_next_chosen = np.zeros(num_envs, bool), np.zeros(num_envs, bool)
        self._logged: set[tuple[str, Reason]] = set()

    def run(self) -> None:
        turn = self._environment.start(self._next_episodes)
        self._begin()
        while turn.batches or len(turn.crashed):
            actions = {group: self._act(group, batch) for group, batch in turn.batches.items()}
            forfeited = np.array(sorted(self._faulty), dtype=np.int64)
            if len(forfeited):
                self._faulty.clear()
                self._end(forfeited)
                self._running[forfeited] = NO_GAME
                self._environment.abandon(forfeited)
                kept = {group: batch.without(forfeited) for group, batch in turn.batches.items()}
                actions = {group: actions[group][rows] for group, rows in kept.items() if len(rows)}
            self._end_step(turn)
            turn = self._environment.step(actions)
            for rows in turn.endings:
                self._returns[rows.envs, rows.agents] += rows.rewards
            if len(turn.finished):
                self._end(turn.finished[~self._in_opening(turn.finished)])
            self._begin()
            self._is_lost[turn.crashed] = True

    def check_deadline(self) -> None:
        """Raise GameTimeout if an environment has worked on its current game for too long."""
        busy = self._environment.busy
        if len(slow := busy[self._environment.seconds()[busy] > self._max_seconds]):
            raise GameTimeout(self._hung(slow))

    def _next_episodes(self, envs: Indices) -> Starts:
        # The next game of each environment, or NO_GAME, and the number of earlier attempts at it.
        games, attempts = np.full(len(envs), NO_GAME), np.zeros(len(envs), np.int64)
        again = np.flatnonzero((self._running[envs] != NO_GAME) & (self._in_opening(envs) | self._is_lost[envs]))
        ended = self._running[envs[again]]
        games[again], attempts[again] = self._games[ended], self._attempts[ended] + ~self._is_lost[envs[again]]
        if attempts.max(initial=0) == MAX_OPENINGS:
            raise EnvironmentMismatch(
                f"play.opening_plies: {MAX_OPENINGS} openings of {self._plies} random steps all ended the game;"
                " fewer are needed"
            )
        if len(again) and self._plies:
            self._openings.restart(games[again], attempts[again])
        free = np.flatnonzero(games == NO_GAME)[: len(self._plans) - self._next_game]
        games[free] = self._next_game + np.arange(len(free))
        self._next_game += len(free)
        starting = np.flatnonzero(games != NO_GAME)
        games, attempts = games[starting], attempts[starting]
        episodes = len(self._games) + np.arange(len(starting))
        self._games, self._attempts = np.append(self._games, games), np.append(self._attempts, attempts)
        self._begun[envs], self._is_next_chosen[envs] = NO_GAME, True
        self._begun[envs[starting]] = episodes
        seating = self._seating
        groups = np.tile(seating.in_opening, (len(games), 1)) if self._plies else seating.after_opening[games]
        return Starts(envs[starting], self._plans.seeds[games], groups)

    def _in_opening(self, envs: Indices) -> NDArray[np.bool_]:
        """Whether games are in their openings. A game that ends there is replaced."""
        return (self._steps[envs] <= self._plies) & (self._plies > 0)

    def _begin(self) -> None:
        """The episodes that environments began in this step are their current ones now."""
        envs = np.flatnonzero(self._is_next_chosen)
        if not len(envs):
            return
        self._is_next_chosen[envs] = self._is_lost[envs] = False
        self._running[envs] = self._begun[envs]
        self._steps[envs] = 0
        self._returns[envs] = 0.0
        self._generators.forget(envs)
        for states in self._states.values():
            states.forget(envs)

    def _act(self, group: int, batch: Batch) -> NDArray:
        """Return the actions of a group's rows."""
        seated, episodes = self._seating.policies[group], self._running[batch.envs]
        self._returns[batch.envs, batch.agents] += batch.rewards
        if seated.policy is None or seated.ref is None:
            actions = self._openings.act(seated.policy_id, batch, self._games[episodes])
        else:
            actions = self._call(group, seated.ref, seated.policy, batch)
        self.recorder.actions.add(episodes, self._steps[batch.envs], batch.agents, actions)
        return actions

    def _call(self, group: int, ref: str, policy: Policy, batch: Batch) -> NDArray:
        """Return a contestant's actions, keep its recurrent states, and note the games that it forfeits."""
        games = self._games[self._running[batch.envs]]
        state = self._states[group].get(batch) if group in self._states else None
        seated = self._seating.policies[group]
        randomness: Randomness = None
        if seated.is_script:
            randomness = self._generators.get(batch, self._plans.seeds[games], self._plans.indices[games])
        elif seated.samples:
            randomness = ActionNumbers(self._keys[games, batch.agents], self._steps[batch.envs])
        answer = call_policy(policy, batch, self._spaces[batch.agents[0]], state, randomness)
        if answer.states is not None:
            if group not in self._states:
                self._states[group] = AgentStates(*self._returns.shape)
            self._states[group].update(batch, answer.states)
        for row, fault in answer.faults.items():
            self.recorder.add_fault(int(games[row]), int(batch.agents[row]), fault)
            self._faulty.add(int(batch.envs[row]))
            if (ref, fault.reason) not in self._logged:  # the first forfeit of a contestant for each reason
                self._logged.add((ref, fault.reason))
                logger.warning("%s forfeits a game (%s): %s", ref, fault.reason, fault.detail)
        return answer.actions

    @cached_property
    def _keys(self) -> NDArray[np.uint64]:
        return action_keys(self._plans.seeds, self._plans.indices, len(self._agents))

    def _end(self, envs: Indices) -> None:
        """Record the games in some environments."""
        episodes = self._running[envs]
        self.recorder.end(self._games[episodes], episodes, self._returns[envs], self._steps[envs])

    def _end_step(self, turn: Turn) -> None:
        playing = np.flatnonzero((self._running != NO_GAME) & turn.acting(len(self._running)))
        self._steps[playing] += 1
        steps = self._steps[playing]
        if self._plies and len(opened := playing[steps == self._plies]):
            self._environment.assign(opened, self._seating.after_opening[self._games[self._running[opened]]])
        if len(endless := playing[steps > self._max_moves]):
            raise GameHung(f"{self._describe(endless[:1])} has not ended after {self._max_moves} moves")
        if len(slow := playing[self._environment.seconds()[playing] > self._max_seconds]):
            raise self._hung(slow[:1])

    def crashed(self, envs: Indices, error: Exception) -> GameCrashed:
        """The error for environments of which one raised."""
        return GameCrashed(
            f"{self._describe(envs)} cannot continue: its environment raised {one_line(error, with_type=True)}"
        )

    def _hung(self, envs: Indices) -> GameHung:
        """The error for games of which one hangs."""
        return GameHung(f"{self._describe(envs)} has not ended after {self._max_seconds:g} s of environment time")

    def _describe(self, envs: Indices) -> str:
        """`a game of duo@1 and duo@2 (game 0 of match duo-3f/17)` for the last games that environments began."""
        game = int(self._games[self._begun[envs[0]]])
        position, index = int(self._plans.positions[game]), int(self._plans.indices[game])
        players = " and ".join(self._schedule.contestants_at(position))
        peers = f", or one of {len(envs) - 1} others that are stepped with it," if len(envs) > 1 else ""
        return f"a game of {players} (game {index} of match {self._schedule.match_id(position)}){peers}"


def _leaf(space: Space) -> Leaf:
    assert not isinstance(space, DictSpace), "action spaces are not dictionaries"
    return space
