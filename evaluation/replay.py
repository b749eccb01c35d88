"""A recorded game, played again step by step from its seed, and checked against the record."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from evaluation.exhibition import Moment, answer, exhibit
from evaluation.play import sides_of
from evaluation.running import contestant_returns
from league.config import LeagueConfig
from league.environments.stepping import BatchedEnvironment
from league.errors import EnvironmentMismatch, IllegalAction
from league.interface import Interface
from league.policies.policy import Actions, Arrays, Policy
from league.results.records import Action, Game, Match
from league.spaces import DictSpace, Space

NOBODY: Mapping[str, Policy] = {}


def replay(
    environment: BatchedEnvironment,
    config: LeagueConfig,
    interface: Interface,
    match: Match,
    index: int,
    players: Mapping[str, Policy] = NOBODY,
) -> Iterator[Moment]:
    """Play game `index` of a match again, on copy 0, and yield it step by step; one that was forfeited up to there.

    players: agent → the policy that played it, which is asked once more how likely each action was. Nothing else
    depends on them; agents without one, and the moves of the opening, have no probabilities.
    Raises EnvironmentMismatch if the environment is not the one of the record, or does not go the way of the record.
    """
    if match.environment_digest != config.environment.digest():
        raise EnvironmentMismatch(f"match {match.id} was played in another environment than {config.league}'s")
    game = match.games[index]
    record = _Record(match.id, [*game.opening, *game.actions], len(game.opening))
    hands = {agent: _Recorded(record, spaces.action, players.get(agent)) for agent, spaces in interface.agents.items()}
    moment = None
    try:
        for moment in exhibit(environment, hands, game.seed):
            is_forfeited = bool(game.forfeits) and not record.left
            if is_forfeited:
                _check_forfeits(match, index, moment, interface)
                moment = replace(moment, is_over=True)
            yield moment
            if is_forfeited:
                break
    except IllegalAction as error:
        raise EnvironmentMismatch(f"match {match.id} cannot be replayed: {error}") from error
    assert moment is not None, "a game has a beginning"
    agents = environment.agents
    returns = [moment.returns[agent] for agent in agents]
    replayed = contestant_returns(returns, sides_of(agents, seated(interface, game)), game.sides)
    if record.left or replayed != game.returns:
        raise EnvironmentMismatch(
            f"match {match.id} cannot be replayed: game {index} returned {replayed}, {game.returns} in the record"
        )


def seated(interface: Interface, game: Game) -> Interface:
    """The interface with the sides that a game was played with: in cross-play each agent of the team is one."""
    return interface if len(game.sides) == len(interface.sides) else interface.apart()


def _check_forfeits(match: Match, index: int, moment: Moment, interface: Interface) -> None:
    """Raise EnvironmentMismatch unless those who forfeited the game had to act at this moment of it."""
    game = match.games[index]
    side_of = {agent: side for side, agents in enumerate(interface.sides.values()) for agent in agents}
    for forfeit in game.forfeits:
        player = game.sides[side_of[forfeit.agent]] if forfeit.agent in side_of else None
        if forfeit.agent not in moment.acting or player != forfeit.contestant:
            who = match.contestants[forfeit.contestant]
            raise EnvironmentMismatch(
                f"match {match.id} cannot be replayed: {who} is recorded to have forfeited game {index} as"
                f" {forfeit.agent}, who had not to act for it there"
            )


class _Record:
    """The recorded actions in their order, `opening` of which nobody chose."""

    def __init__(self, match: str, actions: Sequence[Action], opening: int) -> None:
        self._match, self._actions = match, iter(actions)
        self._chosen = len(actions) - opening
        self.left = len(actions)

    @property
    def is_chosen(self) -> bool:
        """Whether a policy chose the next one."""
        return self.left <= self._chosen

    def take(self) -> Action:
        if not self.left:
            raise EnvironmentMismatch(f"match {self._match} cannot be replayed: the game goes on after its last move")
        self.left -= 1
        return next(self._actions)


class _Recorded:
    """Answers for one agent with the next recorded action; agents are asked in the order of the record."""

    def __init__(self, record: _Record, space: Space, player: Policy | None) -> None:
        assert not isinstance(space, DictSpace), "no policy acts in a dictionary"
        self._record, self._dtype, self._player = record, space.dtype, player

    def act(
        self,
        observations: Arrays,
        *,
        state: Arrays | None = None,
        explore: bool = False,  # noqa: ARG002
        rng: Sequence[np.random.Generator] | None = None,
    ) -> Actions:
        asked = None
        if self._player is not None and self._record.is_chosen:
            asked = answer(self._player, observations, state, rng)
        actions = np.array([self._record.take()], dtype=self._dtype)
        return Actions(actions) if asked is None else replace(asked, actions=actions)
