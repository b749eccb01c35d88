"""Base class of vectorised MPE2 environments."""

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from league.environments.vector.mpe.particles import Particles, Physics, World
from league.environments.vector.vector_env import AgentRows, VectorEnv
from league.spaces import OBSERVATION

MOVES = np.array([[0.0, -1.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, -1.0, 1.0]])
"""Horizontal and vertical control of each discrete movement."""


class ParticleEnv(VectorEnv):
    """An environment of MPE2 in which all agents move, act at once, and stay until `max_cycles`."""

    def __init__(
        self, num_envs: int, agents: Sequence[str], world: World, max_cycles: int, continuous_actions: bool
    ) -> None:
        self.num_envs, self.possible_agents = num_envs, tuple(agents)
        self.world, self._max_cycles, self._continuous = world, max_cycles, continuous_actions
        self._physics = Physics(world)
        self._accelerations = np.array(world.accelerations)[:, np.newaxis, np.newaxis]
        self.landmarks = slice(world.num_agents, world.num_entities)
        self.others = [np.delete(np.arange(world.num_agents), agent) for agent in range(world.num_agents)]
        # Unreachable until their resets.
        self._particles = self.draw(np.zeros(num_envs, dtype=np.int64))
        sizes = [sum(map(len, self.observation(self._particles, agent))) for agent in range(world.num_agents)]
        # Observation size → agents. Those with the same size have the same space.
        self._groups = {size: [agent for agent, its in enumerate(sizes) if its == size] for size in sizes}

    @abstractmethod
    def draw(self, seeds: NDArray[np.int64]) -> Particles:
        """Draw initial states."""

    @abstractmethod
    def observation(self, particles: Particles, agent: int) -> Sequence[NDArray[Any]]:
        """Return the parts of an agent's observation, each of them (size, n)."""

    @abstractmethod
    def rewards(self, particles: Particles) -> NDArray[np.float64]:
        """Return the rewards of all agents, (agents, n) float64."""

    def reset(self, env_ids: NDArray[np.int64], seeds: NDArray[np.int64]) -> Sequence[AgentRows]:
        """See VectorEnv."""
        particles = self.draw(seeds)
        self._particles.update(env_ids, particles)
        rewards = np.zeros((self.world.num_agents, len(env_ids)))
        return self._rows(env_ids, particles, rewards, np.zeros(len(env_ids), dtype=bool))

    def step(self, env_ids: NDArray[np.int64], actions: NDArray[Any]) -> Sequence[AgentRows]:
        """See VectorEnv."""
        particles = self._particles.copies(env_ids)
        # (agents, …, n) from here on.
        actions = np.moveaxis(actions.reshape(len(env_ids), self.world.num_agents, *actions.shape[1:]), 0, -1)
        self._physics.step(particles, self._controls(actions) * self._accelerations)
        particles.steps[:] += 1
        self._particles.update(env_ids, particles)
        return self._rows(env_ids, particles, self.rewards(particles), particles.steps >= self._max_cycles)

    def copy(self, source: NDArray[np.int64], target: NDArray[np.int64]) -> None:
        """See VectorEnv."""
        self._particles.update(target, self._particles.copies(source))

    def state(self, env_ids: NDArray[np.int64]) -> NDArray[np.float32]:
        """See VectorEnv. The state consists of the observations of all agents."""
        return self._observations(self._particles.copies(env_ids), range(self.world.num_agents))

    def relative_positions(self, particles: Particles, agent: int) -> list[NDArray[np.float64]]:
        """Return the positions of landmarks and of other agents relative to an agent, (2 · entities, n) each."""
        positions = particles.positions
        entities = positions[self.landmarks], positions[self.others[agent]]
        return [(part - positions[agent]).reshape(2 * len(part), positions.shape[-1]) for part in entities]

    def _controls(self, actions: NDArray[Any]) -> NDArray[np.float64]:
        """Return horizontal and vertical controls in [-1, 1], (agents, 2, n)."""
        if not self._continuous:
            return np.stack([axis.take(actions) for axis in MOVES], axis=1)
        # The league accepts actions that exceed the bounds by a rounding error.
        actions = np.clip(actions, 0, 1)
        # The sum, as in stock, turns -0.0 into 0.0.
        return 0.0 + (actions[:, 2::2] - actions[:, 1::2]).astype(np.float64)

    def _rows(
        self,
        env_ids: NDArray[np.int64],
        particles: Particles,
        rewards: NDArray[np.float64],
        truncations: NDArray[np.bool_],
    ) -> Sequence[AgentRows]:
        return [
            AgentRows(
                envs=env_ids.repeat(len(agents)),
                agents=np.tile(np.array(agents), len(env_ids)),
                observations={OBSERVATION: self._observations(particles, agents).reshape(-1, size)},
                # The sum, as in stock, turns -0.0 into 0.0.
                rewards=(0.0 + rewards[agents].T).ravel(),
                terminations=np.zeros(len(agents) * len(env_ids), dtype=bool),
                truncations=truncations.repeat(len(agents)),
            )
            for size, agents in self._groups.items()
        ]

    def _observations(self, particles: Particles, agents: Sequence[int]) -> NDArray[np.float32]:
        """Return the concatenated observations of some agents, (n, sizes)."""
        parts = [part for agent in agents for part in self.observation(particles, agent)]
        return np.ascontiguousarray(np.concatenate(parts, dtype=np.float32, casting="same_kind").T)
