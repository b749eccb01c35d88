"""Sources of games to show: live games between contestants, and recorded games replayed and checked step by step."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from evaluation.matches.seating import agent_sides, contestant_returns
from evaluation.playback.single_game import GameStep, play_game, policy_output
from league.config.league import LeagueConfig
from league.environments import building
from league.environments.stepping import BatchedEnvironment
from league.errors import (
    EnvironmentMismatch,
    IllegalAction,
    IllegalMask,
    InvalidReference,
    InvalidReward,
    LeagueError,
    ObservationError,
)
from league.interface import Interface
from league.policies.loading import acting_ref, pinned
from league.policies.policy import Actions, Arrays, Policy
from league.refs import CheckpointRef, parse_ref
from league.registry.registry import Registry
from league.registry.storage.rows import LeagueRow
from league.results.ledger import Ledger
from league.results.records import Action, Game, Match
from league.search.policies import contestant
from league.service_requests import RecordingRequest
from league.spaces import DictSpace, Space

NO_PLAYERS: Mapping[str, Policy] = {}


def replay(
    environment: BatchedEnvironment,
    config: LeagueConfig,
    interface: Interface,
    match: Match,
    index: int,
    players: Mapping[str, Policy] = NO_PLAYERS,
    includes: Callable[[int, bool], bool] | None = None,
) -> Iterator[GameStep]:
    """Replay game `index` of a match in environment 0 and yield its steps. A forfeited game ends at its forfeit.

    players: agent → the policy that played it, to compute action probabilities again. Agents without a policy and
    opening moves have none. includes: number of an action, and whether it is the last → whether to compute them there;
    by default everywhere.
    Raises EnvironmentMismatch if the environment differs from the recorded one or deviates from the record.
    """
    if match.environment_digest != config.environment.digest():
        raise EnvironmentMismatch(f"match {match.id} was not played in the current environment of {config.league}")
    game = match.games[index]
    record = _Record(match.id, [*game.opening, *game.actions], len(game.opening), includes)
    policies = {
        agent: _Recorded(record, spaces.action, players.get(agent)) for agent, spaces in interface.agents.items()
    }
    step = None
    try:
        for step in play_game(environment, policies, game.seed):
            is_forfeited = bool(game.forfeits) and not record.left
            if is_forfeited:
                _check_forfeits(match, index, step, interface)
                step = replace(step, is_over=True)
            yield step
            if is_forfeited:
                break
    except (IllegalAction, IllegalMask, InvalidReward, ObservationError) as error:
        raise EnvironmentMismatch(f"match {match.id} cannot be replayed: {error}") from error
    assert step is not None, "a game has at least one step"
    agents = environment.agents
    returns = [step.returns[agent] for agent in agents]
    replayed = contestant_returns(returns, agent_sides(agents, seated(interface, game)), game.sides)
    if record.left or replayed != game.returns:
        raise EnvironmentMismatch(
            f"match {match.id} cannot be replayed: game {index} returned {replayed}, {game.returns} in the record"
        )


def seated(interface: Interface, game: Game) -> Interface:
    """The interface with the sides of a game. In cross-play, each agent of the team is a side."""
    return interface if len(game.sides) == len(interface.sides) else interface.apart()


def _check_forfeits(match: Match, index: int, step: GameStep, interface: Interface) -> None:
    """Raise EnvironmentMismatch unless the agents that forfeited were about to act."""
    game = match.games[index]
    side_of = {agent: side for side, agents in enumerate(interface.sides.values()) for agent in agents}
    for forfeit in game.forfeits:
        player = game.sides[side_of[forfeit.agent]] if forfeit.agent in side_of else None
        if forfeit.agent not in step.acting or player != forfeit.contestant:
            who = match.contestants[forfeit.contestant]
            raise EnvironmentMismatch(
                f"match {match.id} cannot be replayed: according to the record, {who} forfeited game {index} as"
                f" {forfeit.agent}, which did not have to act then"
            )


class _Record:
    """The recorded actions in order, the first `opening` of which were random."""

    def __init__(
        self, match: str, actions: Sequence[Action], opening: int, includes: Callable[[int, bool], bool] | None
    ) -> None:
        self._match, self._actions, self._includes = match, iter(actions), includes
        self._opening, self._length = opening, len(actions)
        self.left = len(actions)

    @property
    def is_evaluated(self) -> bool:
        """Whether a policy chose the next action, and its probabilities are computed."""
        number = self._length - self.left + 1
        is_included = self._includes is None or self._includes(number, number == self._length)
        return is_included and number > self._opening

    def take(self) -> Action:
        if not self.left:
            raise EnvironmentMismatch(f"match {self._match} cannot be replayed: the game continues after its last move")
        self.left -= 1
        return next(self._actions)


class _Recorded:
    """Plays the next recorded action. Agents act in the recorded order."""

    def __init__(self, record: _Record, space: Space, player: Policy | None) -> None:
        assert not isinstance(space, DictSpace), "action spaces are not dictionaries"
        self._record, self._dtype, self._player = record, space.dtype, player

    def act(
        self,
        observations: Arrays,
        *,
        state: Arrays | None = None,
        explore: bool = False,  # noqa: ARG002
        rng: Sequence[np.random.Generator] | None = None,
    ) -> Actions:
        output = None
        if self._player is not None and self._record.is_evaluated:
            output = policy_output(self._player, observations, state, rng)
        actions = np.array([self._record.take()], dtype=self._dtype)
        return Actions(actions) if output is None else replace(output, actions=actions)


@dataclass(frozen=True, slots=True)
class GameSource:
    """A game that can be played in front of a viewer.

    controllers: agent → reference of who controls it. play: environment with `num_envs` 1 → steps.
    opening: number of random steps at the start. note: remark about its end, in addition to the returns.
    """

    title: str
    config: LeagueConfig
    interface: Interface
    controllers: Mapping[str, str]
    play: Callable[[BatchedEnvironment], Iterator[GameStep]]
    opening: int = 0
    note: str | None = None


def live_game(refs: Sequence[str], registry: Registry, side: str | None = None, seed: int = 0) -> GameSource:
    """A game of `refs`: the first plays `side` (by default the first side), the others the remaining sides in order.

    The last one plays all remaining sides; a single one plays against itself.
    Raises InvalidReference without a version, for too many references and for an unknown side, and loading errors.
    """
    versions = [ref for ref in map(parse_ref, refs) if isinstance(ref, CheckpointRef)]
    if not versions:
        raise InvalidReference(
            "expected at least one version, such as connect_four@champion, which determines the league"
        )
    row = registry.leagues.get(versions[0].league)
    names = [acting_ref(pinned(ref, row.slug, registry), registry, f"game {seed}") for ref in refs]
    current = building.interface(row.config)  # may have changed since the league was registered
    players = {ref: contestant(ref, registry, current, row.config.environment) for ref in names}
    controllers = _controllers(names, row.interface, side)
    policies = {agent: players[ref][agent][1] for agent, ref in controllers.items()}
    return GameSource(
        title=f"{row.slug} · seed {seed}",
        config=row.config,
        interface=row.interface,
        controllers=controllers,
        play=lambda environment: play_game(environment, policies, seed, row.conditions.actions),
    )


def recorded_game(
    match: str, game: int, registry: Registry, chances: bool = False, request: RecordingRequest | None = None
) -> GameSource:
    """Game number `game` of a match in the ledger, replayed exactly.

    chances: compute action probabilities again with those versions that can still be loaded.
    request: if it names a search version, this evaluates the positions in their place, in the requested steps.
    Raises NotFound, InvalidReference if the match has no such game, and what loading the search version raises.
    """
    ledger = Ledger(registry)
    record = ledger.match(match)
    if not 0 <= game < len(record.games):
        raise InvalidReference(f"match {match} has games 0 to {len(record.games) - 1}, not {game}")
    row = registry.leagues.get(record.league)
    agents = list(row.interface.agents)
    seats = zip(agents, agent_sides(agents, seated(row.interface, record.games[game])), strict=True)
    acting = record.acting(game)
    controllers = {agent: acting[record.games[game].sides[side]] for agent, side in seats}
    includes = None
    if request is not None and request.analysis is not None:
        analyst = contestant(f"{row.slug}@{request.analysis}", registry, row.interface, row.config.environment)
        players, includes = {agent: policy for agent, (_, policy) in analyst.items()}, request.includes
    else:
        players = _graphs(controllers, registry, row) if chances else {}
    return GameSource(
        title=f"{match} · game {game}",
        config=row.config,
        interface=row.interface,
        controllers=controllers,
        play=lambda environment: replay(environment, row.config, row.interface, record, game, players, includes),
        opening=ledger.schedule(record.schedule).opening_plies,
        note=_forfeits(record, game),
    )


def _graphs(controllers: Mapping[str, str], registry: Registry, league: LeagueRow) -> dict[str, Policy]:
    """agent → policy, for agents controlled by versions that still exist."""
    contestants: dict[str, Mapping[str, tuple[str, Policy]]] = {}
    for ref in set(controllers.values()):
        if isinstance(parse_ref(ref), CheckpointRef):
            with suppress(LeagueError):
                contestants[ref] = contestant(ref, registry, league.interface, league.config.environment)
    return {agent: contestants[ref][agent][1] for agent, ref in controllers.items() if ref in contestants}


def _forfeits(match: Match, game: int) -> str | None:
    """`forfeited by duo@3 as player_1: illegal action (action 3, legal: 0, 1)`"""
    reasons = [
        f"forfeited by {match.contestants[forfeit.contestant]} as {forfeit.agent}: {forfeit.reason.replace('_', ' ')}"
        + (f" ({forfeit.detail})" if forfeit.detail else "")
        for forfeit in match.games[game].forfeits
    ]
    return "; ".join(reasons) or None


def _controllers(refs: Sequence[str], interface: Interface, first: str | None) -> dict[str, str]:
    sides = list(interface.sides)
    if first is not None and first not in sides:
        raise InvalidReference(f"unknown side {first!r}; known: {', '.join(sides)}")
    if len(refs) > len(sides):
        raise InvalidReference(f"{len(refs)} contestants for {len(sides)} side(s): {', '.join(sides)}")
    sides.sort(key=lambda side: side != first)
    player = {side: refs[min(place, len(refs) - 1)] for place, side in enumerate(sides)}
    return {agent: player[side] for side, agents in interface.sides.items() for agent in agents}
