"""The game loop: plays games in lockstep, with the actions of each policy batched over all games.

A game depends on its plan alone. Openings and scripts use random generators of the game, recurrent states belong to
agents, and a policy's output for a row does not depend on its batch. The number of parallel environments and the other
games therefore do not change a result. This includes forfeits: a contestant without a legal action loses that game
immediately, and the other games continue.
"""

from __future__ import annotations

import logging
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from numpy.typing import NDArray

from evaluation.matches.game_state import RunningGame, State, contestant_returns, stack_states
from evaluation.matches.policy_calls import PolicyFault, PolicyOutput, call_policy
from evaluation.matches.watchdog import Deadline, GameTimeout, enforce_deadline
from evaluation.schedules.builders import GamePlan, game_plans
from league.environments.stepping import Batch, BatchedEnvironment, EpisodeStart, Turn
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
    runner = _LockstepRunner(schedule, positions, environment, interface, roster, max_moves, deadline.seconds)
    try:
        with enforce_deadline(runner.check_deadline, deadline):
            runner.run()
    except GameTimeout as expired:
        raise expired.error from None
    except Exception as error:
        if isinstance(error, LeagueError) or environment.busy is None:
            raise
        raise runner.crashed(environment.busy, error) from error
    return [schedule.match(position, runner.block(position)) for position in positions]


@dataclass(frozen=True, slots=True)
class _PolicyCaller:
    """The policy that acts for the rows of one group."""

    ref: str
    policy: Policy

    def answer(self, batch: Batch, space: Leaf, state: State | None, games: Sequence[RunningGame]) -> PolicyOutput:
        """Stochastic policies get one RNG per row; checkpoints play greedily. Openings cannot be forfeited."""
        if self.ref != OPENING and not self.ref.startswith("script:"):
            return call_policy(self.policy, batch, space, state, None)
        generators = [game.draws(agent) for game, agent in zip(games, batch.agents, strict=True)]
        if self.ref != OPENING:
            return call_policy(self.policy, batch, space, state, generators)
        return PolicyOutput(self.policy.act(batch.observations, rng=generators).actions, None)


class _LockstepRunner:
    """Assigns games to parallel environments and policies to agents."""

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
        self._side_of = agent_sides(environment.agents, interface)
        self._policy_of = [interface.policies[agent] for agent in environment.agents]
        self._roster = roster
        self._actors = _callers(interface, roster, opening=self._plies > 0)
        self._waiting = (game for position in positions for game in game_plans(schedule, position))
        self._running: list[RunningGame | None] = [None] * environment.num_envs
        self._next_games: dict[int, RunningGame | None] = {}
        """The last game that each environment began: during a reset, the upcoming one."""
        self._recurrent_groups: set[Hashable] = set()
        self._finished: dict[int, dict[int, Game]] = {position: {} for position in positions}
        self._logged: set[tuple[str, Reason]] = set()

    def run(self) -> None:
        turn = self._environment.start(self._next_episode)
        self._assign(self._next_games)
        while turn.batches:
            actions = {group: self._act(group, batch) for group, batch in turn.batches.items()}
            forfeited = self._forfeited()
            if forfeited:
                self._environment.abandon(forfeited)
                actions = _without(turn, actions, forfeited)
            self._end_step()
            turn = self._environment.step(actions)
            self._assign({env: self._next_games[env] for env in forfeited})
            self._settle(turn)

    def check_deadline(self) -> None:
        """Raise GameTimeout if the environment has worked on its current game for too long."""
        env = self._environment.busy
        if env is not None and self._environment.seconds(env) > self._max_seconds:
            raise GameTimeout(self._hung(env))

    def block(self, position: int) -> list[Game]:
        """The scored games at `position`, in order."""
        games = [game for _, game in sorted(self._finished[position].items())]
        forfeits = [{forfeit.contestant for forfeit in game.forfeits} for game in games]
        points = scores([game.returns for game in games], self._scoring, forfeits)
        return [replace(game, scores=own) for game, own in zip(games, points, strict=True)]

    def _next_episode(self, env: int) -> EpisodeStart | None:
        ended = self._running[env]
        if ended is not None and self._in_opening(ended):
            game = self._redraw(ended)
        else:
            waiting = next(self._waiting, None)
            if waiting is None:
                self._next_games[env] = None
                return None
            game = self._fresh(waiting, 0)
        self._next_games[env] = game
        return EpisodeStart(game.plan.seed, self._groups(game))

    def _fresh(self, game: GamePlan, attempt: int) -> RunningGame:
        return RunningGame(game, [0.0] * len(self._agents), attempt, opening=None if self._plies else 0)

    def _redraw(self, ended: RunningGame) -> RunningGame:
        if ended.attempt + 1 == MAX_OPENINGS:
            raise EnvironmentMismatch(
                f"play.opening_plies: {MAX_OPENINGS} openings of {self._plies} random steps all ended the game;"
                " fewer are needed"
            )
        return self._fresh(ended.plan, ended.attempt + 1)

    def _in_opening(self, game: RunningGame) -> bool:
        """Whether the game is in its opening. A game that ends there is replaced."""
        return 0 < self._plies >= game.steps

    def _groups(self, game: RunningGame) -> list[Hashable]:
        if game.opening is None:
            return [(OPENING, policy) for policy in self._policy_of]
        contestants = (game.plan.contestants[game.plan.sides[side]] for side in self._side_of)
        return [(ref, self._roster[ref][agent][0]) for ref, agent in zip(contestants, self._agents, strict=True)]

    def _act(self, group: Hashable, batch: Batch) -> NDArray:
        actor = self._actors[group]
        games = [self._game(env) for env in batch.envs]
        for game, agent, reward in zip(games, batch.agents, batch.rewards, strict=True):
            game.returns[agent] += reward
        state = None
        if group in self._recurrent_groups:
            state = stack_states([game.states.get(agent) for game, agent in zip(games, batch.agents, strict=True)])
        answer = actor.answer(batch, self._spaces[batch.agents[0]], state, games)
        for game, agent, action in zip(games, batch.agents, answer.actions.tolist(), strict=True):
            game.act(agent, action)
        if answer.states is not None:
            self._recurrent_groups.add(group)
            for game, agent, own in zip(games, batch.agents, answer.states, strict=True):
                game.states[agent] = own
        for row, fault in answer.faults.items():
            games[row].faults[batch.agents[row]] = fault.reason
            self._log_forfeit(actor.ref, fault)
        return answer.actions

    def _log_forfeit(self, ref: str, fault: PolicyFault) -> None:
        """Log the details of a forfeit once. The record contains only the reason."""
        if (ref, fault.reason) not in self._logged:
            self._logged.add((ref, fault.reason))
            logger.warning("%s forfeits a game (%s): %s", ref, fault.reason, fault.detail)

    def _forfeited(self) -> list[int]:
        """Record games that end by forfeit and return their environments."""
        envs = [env for env, game in enumerate(self._running) if game is not None and game.faults]
        for env in envs:
            game = self._game(env)
            self._finished[game.plan.position][game.plan.index] = self._record(game)
            self._running[env] = None
        return envs

    def crashed(self, env: int, error: Exception) -> GameCrashed:
        """The error for an environment that raised."""
        return GameCrashed(
            f"{self._describe(env)} cannot continue: its environment raised {one_line(error, with_type=True)}"
        )

    def _hung(self, env: int) -> GameHung:
        return GameHung(f"{self._describe(env)} has not ended after {self._max_seconds:g} s of environment time")

    def _describe(self, env: int) -> str:
        """`a game of duo@1 and duo@2 (game 0 of match duo-3f/17)` for the last game that an environment began."""
        game = self._next_games[env]
        assert game is not None, "an idle environment plays no game"
        players = " and ".join(game.plan.contestants)
        return f"a game of {players} (game {game.plan.index} of match {self._match_id(game.plan.position)})"

    def _end_step(self) -> None:
        for env, game in enumerate(self._running):
            if game is None:
                continue
            if game.end_step(self._plies):
                self._environment.assign(env, self._groups(game))
            elif game.steps > self._max_moves:
                raise GameHung(f"{self._describe(env)} has not ended after {self._max_moves} moves")
            if self._environment.seconds(env) > self._max_seconds:
                raise self._hung(env)

    def _settle(self, turn: Turn) -> None:
        for ending in turn.endings:
            self._game(ending.env).returns[ending.agent] += ending.reward
        for env in turn.finished:
            game = self._game(env)
            if not self._in_opening(game):
                self._finished[game.plan.position][game.plan.index] = self._record(game)
        self._assign({env: self._next_games[env] for env in turn.finished})

    def _assign(self, games: Mapping[int, RunningGame | None]) -> None:
        for env, game in games.items():
            self._running[env] = game

    def _game(self, env: int) -> RunningGame:
        game = self._running[env]
        assert game is not None, "an idle environment does not act"
        return game

    def _record(self, game: RunningGame) -> Game:
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


def agent_sides(agents: Sequence[str], interface: Interface) -> list[int]:
    """The number of each agent's side."""
    side = {agent: i for i, members in enumerate(interface.sides.values()) for agent in members}
    return [side[agent] for agent in agents]


def _without(turn: Turn, actions: Mapping[Hashable, NDArray], envs: Sequence[int]) -> dict[Hashable, NDArray]:
    """The actions of all rows that do not belong to these environments."""
    kept = {group: batch.without(envs) for group, batch in turn.batches.items()}
    return {group: actions[group][rows] for group, rows in kept.items() if rows}


def _leaf(space: Space) -> Leaf:
    assert not isinstance(space, DictSpace), "action spaces are not dictionaries"
    return space


def _callers(interface: Interface, roster: Roster, opening: bool) -> dict[Hashable, _PolicyCaller]:
    actors: dict[Hashable, _PolicyCaller] = {
        (ref, policy_id): _PolicyCaller(ref, policy)
        for ref, agents in roster.items()
        for policy_id, policy in agents.values()
    }
    for policy_id in interface.policy_ids if opening else ():
        spaces = interface.of_policy(policy_id)
        actors[OPENING, policy_id] = _PolicyCaller(OPENING, script("random", spaces.observation, spaces.action))
    return actors
