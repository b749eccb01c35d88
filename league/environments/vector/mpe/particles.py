"""Physics of MPE2 for many copies of a world.

Each result is rounded as in `mpe2._mpe_utils.core`: float64, the same functions, the same order of operations.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

TIME_STEP = 0.1
DAMPING = 0.25
CONTACT_FORCE = 1e2
CONTACT_MARGIN = 1e-3
UNDERFLOW = -746.0
"""exp(x) is 0 below this."""


@dataclass(frozen=True, slots=True)
class World:
    """Constants of a world.

    Attributes:
        num_agents: Agents are the first entities. Landmarks, which follow, do not move.
        num_landmarks: Number of landmarks.
        sizes: Radii of the entities that collide, which are the first ones.
        accelerations: Factor from a control in [-1, 1] to a force, for each agent.
        max_speeds: Speed limit of each agent; empty if there are none.
    """

    num_agents: int
    num_landmarks: int
    sizes: Sequence[float]
    accelerations: Sequence[float]
    max_speeds: Sequence[float] = ()

    @property
    def num_entities(self) -> int:
        """Number of agents and landmarks."""
        return self.num_agents + self.num_landmarks


@dataclass(frozen=True, slots=True)
class Particles:
    """State of n copies of a world.

    Attributes:
        positions: (entities, 2, n) float64.
        velocities: (agents, 2, n) float64.
        goals: Index of the landmark that is the goal, (n,) int64; 0 in games without one.
        steps: Number of steps since the reset, (n,) int64.
    """

    positions: NDArray[np.float64]
    velocities: NDArray[np.float64]
    goals: NDArray[np.int64]
    steps: NDArray[np.int64]

    def copies(self, envs: NDArray[np.int64]) -> "Particles":
        """Return some of the copies. Only if these are all, changes of the result change this state."""
        if len(envs) == len(self.steps):
            return self
        return Particles(*(array.take(envs, axis=-1) for array in self._arrays()))

    def update(self, envs: NDArray[np.int64], particles: "Particles") -> None:
        """Replace some of the copies."""
        if particles is self:
            return
        for array, new in zip(self._arrays(), particles._arrays(), strict=True):
            array[..., envs] = new

    def _arrays(self) -> tuple[NDArray, ...]:
        return self.positions, self.velocities, self.goals, self.steps


def at_rest(world: World, positions: NDArray[np.float64], goals: NDArray[np.int64] | None = None) -> Particles:
    """Return particles that do not move. goals: (n,), by default 0."""
    n = positions.shape[-1]
    return Particles(
        positions,
        velocities=np.zeros((world.num_agents, 2, n)),
        goals=np.zeros(n, dtype=np.int64) if goals is None else goals,
        steps=np.zeros(n, dtype=np.int64),
    )


def lengths(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the Euclidean norms of vectors (…, 2, n), (…, n)."""
    squares = np.square(vectors)
    return np.sqrt(squares[..., 0, :] + squares[..., 1, :])


class Physics:
    """Moves particles by a time step."""

    def __init__(self, world: World) -> None:
        colliding = range(len(world.sizes))
        # Two landmarks exert no force on each other.
        self._pairs = [(a, b) for a in colliding for b in colliding[a + 1 :] if a < world.num_agents]
        self._first, self._second = np.array(self._pairs, dtype=np.int64).reshape(-1, 2).T
        self._contacts = np.array([[world.sizes[a] + world.sizes[b]] for a, b in self._pairs])
        self._max_speeds = np.array(world.max_speeds)[:, np.newaxis]

    def step(self, particles: Particles, forces: NDArray[np.float64]) -> None:
        """Move the particles, in place. forces: of the agents' actions, (agents, 2, n) float64; overwritten."""
        positions, velocities = particles.positions, particles.velocities
        if self._pairs:
            deltas = positions.take(self._first, axis=0) - positions.take(self._second, axis=0)
            distances = lengths(deltas)
            exponents = -(distances - self._contacts) / CONTACT_MARGIN
            penetrations = np.zeros_like(distances)
            # The others are exactly 0.
            near = exponents > UNDERFLOW
            penetrations[near] = np.logaddexp(0, exponents[near]) * CONTACT_MARGIN
            repulsions = CONTACT_FORCE * deltas / distances[:, np.newaxis] * penetrations[:, np.newaxis]
            # Sums are rounded in the order of the pairs.
            for (a, b), repulsion in zip(self._pairs, repulsions, strict=True):
                forces[a] += repulsion
                if b < len(forces):
                    forces[b] -= repulsion
        positions[: len(velocities)] += velocities * TIME_STEP
        velocities *= 1 - DAMPING
        forces *= TIME_STEP
        velocities += forces
        if self._max_speeds.size:
            speeds = lengths(velocities)
            agents, envs = np.nonzero(speeds > self._max_speeds)
            limited = velocities[agents, :, envs] / speeds[agents, envs, np.newaxis] * self._max_speeds[agents]
            velocities[agents, :, envs] = limited
