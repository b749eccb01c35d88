"""Vectorised `mpe2.simple_reference_v3`: each of two agents tells the other its goal."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from league.environments.vector.mpe.arguments import COMMON, check_ratio, reject_changed
from league.environments.vector.mpe.initial_states import goals_and_positions
from league.environments.vector.mpe.particle_env import ParticleEnv, relative
from league.environments.vector.mpe.particles import Particles, World, at_rest, lengths

COLORS = np.array([[0.75, 0.25, 0.25], [0.25, 0.75, 0.25], [0.25, 0.25, 0.75]])
"""Colours of the landmarks, in rows: red, green, blue."""


class SimpleReference(ParticleEnv):
    """Two agents, each of which moves and says one of ten symbols, and three landmarks. Nobody collides.

    Goal i is the landmark that agent 1 - i shall reach. Only agent i knows it.
    """

    def __init__(
        self,
        num_envs: int,
        local_ratio: float = 0.5,
        max_cycles: int = 25,
        continuous_actions: bool = False,
        **others: Any,
    ) -> None:
        reject_changed(others, COMMON)
        check_ratio(local_ratio)
        self._local_ratio = local_ratio
        world = World(num_agents=2, num_landmarks=3, sizes=(), accelerations=[5.0, 5.0], num_symbols=10)
        super().__init__(num_envs, ["agent_0", "agent_1"], world, max_cycles, continuous_actions)

    def draw(self, seeds: NDArray[np.int64]) -> Particles:
        """See ParticleEnv."""
        goals, positions = goals_and_positions(seeds, 2, self.world.num_landmarks, self.world.num_entities)
        return at_rest(self.world, positions, goals)

    def observation(self, particles: Particles, agent: int) -> Sequence[NDArray[Any]]:
        """See ParticleEnv."""
        return (
            particles.velocities[agent],
            relative(particles.positions, agent, self.landmarks),
            COLORS.take(particles.goals[agent], axis=1),
            particles.messages[1 - agent],
        )

    def rewards(self, particles: Particles) -> NDArray[np.float64]:
        """Mix both agents' mean with each agent's own reward, which is for the distance of the other from its goal."""
        own_rewards = -lengths(particles.positions[[1, 0]] - self.goal_positions(particles))
        common = (0.0 + own_rewards[0] + own_rewards[1]) / 2
        return common * (1 - self._local_ratio) + own_rewards * self._local_ratio
