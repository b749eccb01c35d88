"""A recorded game, played again move by move from its seed, and checked against the record."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from evaluation.exhibition import Moment, exhibit
from evaluation.match import scores
from evaluation.play import contestant_returns, sides_of
from league.config import LeagueConfig
from league.errors import EnvironmentMismatch, IllegalAction
from league.interface import Interface
from league.policies.policy import Actions, Arrays
from league.results.records import Action, Match


def replay(config: LeagueConfig, interface: Interface, match: Match, index: int) -> Iterator[Moment]:
    """Play game `index` of a match again and yield it moment by moment.

    Raises EnvironmentMismatch if the environment is not the one of the record, or does not go the way of the record.
    """
    if match.environment_digest != config.environment.digest():
        raise EnvironmentMismatch(f"match {match.id} was played in another environment than {config.league}'s")
    game = match.games[index]
    agents = list(interface.agents)
    script = _Recorded(match.id, [*game.opening, *game.actions])
    returns = dict.fromkeys(agents, 0.0)
    try:
        for moment in exhibit(config, dict.fromkeys(agents, script), game.seed):
            returns[moment.agent] += moment.reward
            yield moment
    except IllegalAction as error:
        raise EnvironmentMismatch(f"match {match.id} cannot be replayed: {error}") from error
    replayed = contestant_returns(list(returns.values()), sides_of(agents, interface), game.sides)
    if script.left or replayed != game.returns or scores(replayed) != game.scores:
        raise EnvironmentMismatch(
            f"match {match.id} cannot be replayed: game {index} returned {replayed}, {game.returns} in the record"
        )


class _Recorded:
    """Answers with the recorded actions in their order, whoever is asked."""

    def __init__(self, match: str, actions: Sequence[Action]) -> None:
        self._match, self._actions = match, iter(actions)
        self.left = len(actions)

    def act(
        self,
        observations: Arrays,  # noqa: ARG002
        *,
        state: Arrays | None = None,  # noqa: ARG002
        explore: bool = False,  # noqa: ARG002
        rng: Sequence[np.random.Generator] | None = None,  # noqa: ARG002
    ) -> Actions:
        if not self.left:
            raise EnvironmentMismatch(f"match {self._match} cannot be replayed: the game goes on after its last move")
        self.left -= 1
        return Actions(np.array([next(self._actions)]))
