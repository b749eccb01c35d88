"""Vectorised `mpe2.simple_tag_v3`: slow adversaries chase fast agents around obstacles."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from league.environments.vector.mpe.arguments import COMMON, CURRICULUM, NEIGHBORS, check_counts, reject_changed
from league.environments.vector.mpe.particle_env import ParticleEnv
from league.environments.vector.mpe.particles import Particles, World, at_rest, lengths
from league.random import pcg64

ADVERSARY_SIZE, GOOD_SIZE, OBSTACLE_SIZE = 0.075, 0.05, 0.2
ADVERSARY_ACCELERATION, GOOD_ACCELERATION = 3.0, 4.0
ADVERSARY_SPEED, GOOD_SPEED = 1.0, 1.3


class SimpleTag(ParticleEnv):
    """Adversaries, then good agents, whose velocities all others observe, and obstacles."""

    def __init__(
        self,
        num_envs: int,
        num_good: int = 1,
        num_adversaries: int = 3,
        num_obstacles: int = 2,
        max_cycles: int = 25,
        continuous_actions: bool = False,
        **others: Any,
    ) -> None:
        reject_changed(others, COMMON | NEIGHBORS | CURRICULUM)
        check_counts(1, num_good=num_good, num_adversaries=num_adversaries)
        check_counts(0, num_obstacles=num_obstacles)
        self._adversaries = num_adversaries
        agents = [f"adversary_{i}" for i in range(num_adversaries)] + [f"agent_{i}" for i in range(num_good)]
        world = World(
            num_agents=len(agents),
            num_landmarks=num_obstacles,
            sizes=[ADVERSARY_SIZE] * num_adversaries + [GOOD_SIZE] * num_good + [OBSTACLE_SIZE] * num_obstacles,
            accelerations=[ADVERSARY_ACCELERATION] * num_adversaries + [GOOD_ACCELERATION] * num_good,
            max_speeds=[ADVERSARY_SPEED] * num_adversaries + [GOOD_SPEED] * num_good,
        )
        super().__init__(num_envs, agents, world, max_cycles, continuous_actions)

    def draw(self, seeds: NDArray[np.int64]) -> Particles:
        """See ParticleEnv."""
        outputs = pcg64.outputs(seeds, 2 * self.world.num_entities)
        agents, obstacles = np.split(outputs, [2 * self.world.num_agents])
        positions = np.concatenate([pcg64.uniform(agents, -1.0, 1.0), pcg64.uniform(obstacles, -0.9, 0.9)])
        return at_rest(self.world, positions.reshape(self.world.num_entities, 2, -1))

    def observation(self, particles: Particles, agent: int) -> Sequence[NDArray[Any]]:
        """See ParticleEnv."""
        velocities, other_agents = particles.velocities, self.others[agent]
        good = other_agents[other_agents >= self._adversaries]
        return (
            velocities[agent],
            particles.positions[agent],
            *self.relative_positions(particles, agent),
            velocities[good].reshape(2 * len(good), velocities.shape[-1]),
        )

    def rewards(self, particles: Particles) -> NDArray[np.float64]:
        """Reward all adversaries for each contact, and penalise good agents for contacts and for leaving the arena."""
        agents = particles.positions[: self.world.num_agents]
        adversaries, good = np.split(agents, [self._adversaries])
        contacts = lengths(good[:, np.newaxis] - adversaries) < GOOD_SIZE + ADVERSARY_SIZE
        caught = 10.0 * contacts.sum(axis=1)
        horizontal, vertical = bound_penalties(np.abs(good)).swapaxes(0, 1)
        return np.concatenate([[caught.sum(axis=0)] * len(adversaries), 0.0 - caught - horizontal - vertical])


def bound_penalties(distances: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the penalty for each absolute coordinate: 0 below 0.9, and at most 10."""
    penalties = np.where(distances < 0.9, 0.0, (distances - 0.9) * 10)
    outside = distances >= 1.0
    penalties[outside] = np.minimum(np.exp(2 * distances[outside] - 2), 10.0)
    return penalties
