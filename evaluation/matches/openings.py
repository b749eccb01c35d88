"""Random opening moves, which are equal in both games of a block and different for each attempt at an opening."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from league.environments.stepping import Batch, Indices
from league.interface import Interface
from league.policies.draws import UniformNumbers
from league.policies.scripted import Random
from league.random import pcg64
from league.random.seeds import spawn_key


class OpeningMoves:
    """Chooses the opening moves of some games.

    The random numbers of an agent are those of `generator(seed, "opening", attempt, agent)`. They are computed for all
    games together, because creating so many generators takes longer than playing the openings.
    """

    def __init__(self, interface: Interface, agents: int, seeds: Indices, plies: int) -> None:
        """seeds: of the games, (g,). plies: length of the openings in environment steps."""
        spaces = {policy: interface.of_policy(policy) for policy in interface.policy_ids if plies}
        self._scripts = {
            policy: Random(policy_spaces.observation, policy_spaces.action) for policy, policy_spaces in spaces.items()
        }
        self._seeds, self._agents = seeds, agents
        self._count = plies * max((script.numbers_per_action for script in self._scripts.values()), default=0)
        self._numbers = self._computed(np.arange(len(seeds)), np.zeros(len(seeds), np.int64))
        self._used = np.zeros((len(seeds), agents), np.int64)

    def act(self, policy: str, batch: Batch, games: Indices) -> NDArray:
        """Return random legal actions of a batch's rows, which belong to these games, (k, …)."""
        return self._scripts[policy].act(batch.observations, rng=_NumbersOfRows(self, games, batch.agents)).actions

    def restart(self, games: Indices, attempts: Indices) -> None:
        """Begin other openings of some games. attempts: numbers of their earlier openings."""
        self._numbers[games] = self._computed(games, attempts)
        self._used[games] = 0

    def draw(self, games: Indices, agents: Indices, count: int) -> NDArray[np.float64]:
        """Return the next numbers of k agents, (k, count)."""
        first = self._used[games, agents]
        self._used[games, agents] = first + count
        return self._numbers[games[:, np.newaxis], agents[:, np.newaxis], first[:, np.newaxis] + np.arange(count)]

    def _computed(self, games: Indices, attempts: Indices) -> NDArray[np.float64]:
        """The numbers of all agents in some games, (games, agents, numbers)."""
        seeds, numbers = np.repeat(self._seeds[games], self._agents), np.repeat(attempts, self._agents)
        agents = np.tile(np.arange(self._agents), len(games))
        outputs = pcg64.outputs(seeds, self._count, spawn_key("opening", numbers, agents))
        return pcg64.uniform(outputs, 0.0, 1.0).T.reshape(len(games), self._agents, self._count)


class _NumbersOfRows(UniformNumbers):
    """The random numbers of the rows of one batch."""

    def __init__(self, openings: OpeningMoves, games: Indices, agents: Indices) -> None:
        self._openings, self._games, self._agents = openings, games, agents

    def draw(self, shape: tuple[int, ...]) -> NDArray[np.float64]:
        count = int(np.prod(shape, dtype=int))
        return self._openings.draw(self._games, self._agents, count).reshape(-1, *shape)
