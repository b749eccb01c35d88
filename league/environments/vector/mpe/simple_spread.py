"""Vectorised `mpe2.simple_spread_v3`: agents cover landmarks without colliding."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from league.environments.vector.mpe.arguments import (
    COMMON,
    CURRICULUM,
    NEIGHBORS,
    check_counts,
    reject_changed,
)
from league.environments.vector.mpe.initial_states import positions_only
from league.environments.vector.mpe.particle_env import ParticleEnv
from league.environments.vector.mpe.particles import Particles, World, at_rest, lengths
from league.environments.vector.vector_env import UnsupportedArguments

SIZE = 0.15


class SimpleSpread(ParticleEnv):
    """N agents and N landmarks. Agents observe each other's messages, which are always 0."""

    def __init__(
        self,
        num_envs: int,
        N: int = 3,  # noqa: N803
        local_ratio: float = 0.5,
        max_cycles: int = 25,
        continuous_actions: bool = False,
        **others: Any,
    ) -> None:
        reject_changed(others, COMMON | NEIGHBORS | CURRICULUM)
        check_counts(1, N=N)
        if not isinstance(local_ratio, int | float) or not 0 <= local_ratio <= 1:
            raise UnsupportedArguments(f"local_ratio={local_ratio!r}")
        self._local_ratio = local_ratio
        self._pairs = [(a, b) for a in range(N) for b in range(a + 1, N)]
        world = World(num_agents=N, num_landmarks=N, sizes=[SIZE] * N, accelerations=[5.0] * N)
        super().__init__(num_envs, [f"agent_{i}" for i in range(N)], world, max_cycles, continuous_actions)

    def draw(self, seeds: NDArray[np.int64]) -> Particles:
        """See ParticleEnv."""
        return at_rest(self.world, positions_only(seeds, self.world.num_entities))

    def observation(self, particles: Particles, agent: int) -> Sequence[NDArray[Any]]:
        """See ParticleEnv."""
        silence = np.zeros((2 * len(self.others[agent]), len(particles.steps)), dtype=np.float32)
        return (
            particles.velocities[agent],
            particles.positions[agent],
            *self.relative_positions(particles, agent),
            silence,
        )

    def rewards(self, particles: Particles) -> NDArray[np.float64]:
        """Mix the common reward for covered landmarks with each agent's own for collisions."""
        agents, landmarks = particles.positions[: self.world.num_agents], particles.positions[self.landmarks]
        n = agents.shape[-1]
        coverage = np.zeros(n)
        for distances in lengths(agents[:, np.newaxis] - landmarks).min(axis=0):
            coverage -= distances
        collisions = np.zeros((len(agents), n))
        for a, b in self._pairs:
            hits = lengths(agents[a] - agents[b]) < SIZE + SIZE
            collisions[a] -= hits
            collisions[b] -= hits
        return coverage * (1 - self._local_ratio) + collisions * self._local_ratio
