"""State of games in progress: the random numbers and recurrent states of their agents."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from league.environments.stepping import Batch, Indices
from league.policies.draws import UniformNumbers
from league.random import pcg64, splitmix64
from league.random.pcg64 import generate_state
from league.random.seeds import generators, spawn_key

State = dict[str, NDArray]
"""name of a recurrent input → array (k, …)"""


class AgentGenerators:
    """The random generators of scripts, by environment and agent. They are created when their agents first act."""

    def __init__(self, num_envs: int, agents: int) -> None:
        self._kept = np.full((num_envs, agents), None, dtype=object)

    def get(self, batch: Batch, seeds: Indices, indices: Indices) -> list[np.random.Generator]:
        """Return a generator for each row of a batch.

        seeds, indices: of the games, and their numbers in their blocks, (k,).
        """
        row_generators = self._kept[batch.envs, batch.agents]
        if len(missing := np.flatnonzero(row_generators == None)):  # noqa: E711  elementwise
            agents = batch.agents[missing]
            row_generators[missing] = generators(seeds[missing], "policy", indices[missing], agents)
            self._kept[batch.envs[missing], agents] = row_generators[missing]
        return row_generators.tolist()

    def forget(self, envs: Indices) -> None:
        """The games in `envs` are over."""
        self._kept[envs] = None


@dataclass(frozen=True, slots=True)
class ActionNumbers(UniformNumbers):
    """The random numbers with which versions sample the actions of k rows, a function of game, agent and step.

    Nothing is kept between steps, and one game's numbers do not depend on the others in its batch.

    Attributes:
        keys: Seeds of the agents' generators in their games, (k,); see `action_keys`.
        steps: Steps of the games, from 0, (k,).
    """

    keys: NDArray[np.uint64]
    steps: Indices

    def draw(self, shape: tuple[int, ...]) -> NDArray[np.float64]:
        """Return the numbers of this step, (k, *shape). Repeated calls return the same ones."""
        count = int(np.prod(shape, dtype=int))
        numbers = self.steps[:, np.newaxis] * count + np.arange(count)
        outputs = splitmix64.outputs(self.keys[:, np.newaxis], numbers)
        return pcg64.uniform(outputs, 0.0, 1.0).reshape(-1, *shape)

    def row(self, row: int) -> ActionNumbers:
        """Return the numbers of one row."""
        return ActionNumbers(self.keys[row : row + 1], self.steps[row : row + 1])


def action_keys(seeds: Indices, indices: Indices, agents: int) -> NDArray[np.uint64]:
    """Return the seeds of the generators with which the agents of some games sample their actions, (g, agents).

    seeds, indices: of the games, and their numbers in their blocks, (g,).
    """
    columns = np.repeat(seeds, agents), np.repeat(indices, agents), np.tile(np.arange(agents), len(seeds))
    return generate_state(columns[0], spawn_key("action", *columns[1:]))[0].reshape(len(seeds), agents)


class AgentStates:
    """Recurrent states of the agents that one policy controls, by environment and agent.

    Agents without a state get zeros, the initial state of a graph, if they act together with others that have one.
    """

    def __init__(self, num_envs: int, agents: int) -> None:
        self._shape = num_envs, agents
        self._known = np.zeros(self._shape, dtype=bool)
        self._kept: State = {}

    def get(self, batch: Batch) -> State | None:
        """The states before the step of a batch's rows. None if no row has one, which a policy treats as the start of
        an episode.
        """
        if not self._known[batch.envs, batch.agents].any():
            return None
        return {name: kept[batch.envs, batch.agents] for name, kept in self._kept.items()}

    def update(self, batch: Batch, after: State) -> None:
        """Store the states after the step of a batch's rows."""
        for name, values in after.items():
            if name not in self._kept:
                self._kept[name] = np.zeros((*self._shape, *values.shape[1:]), values.dtype)
            self._kept[name][batch.envs, batch.agents] = values
        self._known[batch.envs, batch.agents] = True

    def forget(self, envs: Indices) -> None:
        """The games in `envs` are over."""
        self._known[envs] = False
        for kept in self._kept.values():
            kept[envs] = 0
