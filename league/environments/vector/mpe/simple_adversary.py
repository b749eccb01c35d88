"""Vectorised `mpe2.simple_adversary_v3`: agents reach a landmark that their adversary does not know."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from league.environments.vector.mpe.arguments import COMMON, NEIGHBORS, check_counts, reject_changed
from league.environments.vector.mpe.initial_states import goals_and_positions
from league.environments.vector.mpe.particle_env import ParticleEnv
from league.environments.vector.mpe.particles import Particles, World, at_rest, lengths


class SimpleAdversary(ParticleEnv):
    """An adversary, N agents that know the goal, and N landmarks. Nobody collides."""

    def __init__(
        self,
        num_envs: int,
        N: int = 2,  # noqa: N803
        max_cycles: int = 25,
        continuous_actions: bool = False,
        **others: Any,
    ) -> None:
        reject_changed(others, COMMON | NEIGHBORS)
        check_counts(1, N=N)
        agents = ["adversary_0", *(f"agent_{i}" for i in range(N))]
        world = World(num_agents=N + 1, num_landmarks=N, sizes=(), accelerations=[5.0] * (N + 1))
        super().__init__(num_envs, agents, world, max_cycles, continuous_actions)

    def draw(self, seeds: NDArray[np.int64]) -> Particles:
        """See ParticleEnv."""
        goals, positions = goals_and_positions(seeds, self.world.num_landmarks, self.world.num_entities)
        return at_rest(self.world, positions, goals)

    def observation(self, particles: Particles, agent: int) -> Sequence[NDArray[Any]]:
        """See ParticleEnv."""
        entities = self.relative_positions(particles, agent)
        if agent == 0:
            return entities
        return self._goals(particles) - particles.positions[agent], *entities

    def rewards(self, particles: Particles) -> NDArray[np.float64]:
        """Reward the adversary for its own distance from the goal, and the agents for both sides' distances."""
        agents = particles.positions[: self.world.num_agents]
        distances = lengths(agents - self._goals(particles))
        good = -distances[1:].min(axis=0) + distances[0]
        return np.stack([-distances[0], *[good] * (len(agents) - 1)])

    def _goals(self, particles: Particles) -> NDArray[np.float64]:
        """Return the positions of the goals, (2, n)."""
        return particles.positions[self.landmarks][particles.goals, :, np.arange(len(particles.steps))].T
