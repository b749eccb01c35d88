"""Initial states that MPE2 draws: a goal, then positions."""

import numpy as np
from numpy.typing import NDArray

from league.random import pcg64


def goals_and_positions(
    seeds: NDArray[np.int64], landmarks: int, entities: int
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Draw a goal, the index of a landmark, and positions in [-1, 1]²: (m,) and (entities, 2, m)."""
    if landmarks == 1:
        # NumPy draws nothing if there is no choice.
        return np.zeros(len(seeds), dtype=np.int64), positions_only(seeds, entities)
    outputs = pcg64.outputs(seeds, 1 + 2 * entities)
    goals, accepted = pcg64.integers(outputs[0], landmarks)
    positions = pcg64.uniform(outputs[1:], -1.0, 1.0)
    for i in np.flatnonzero(~accepted):
        # At most one seed in four billion: NumPy draws again.
        generator = np.random.default_rng(int(seeds[i]))
        goals[i] = generator.integers(landmarks)
        positions[:, i] = generator.uniform(-1.0, 1.0, 2 * entities)
    return goals, positions.reshape(entities, 2, -1)


def positions_only(seeds: NDArray[np.int64], entities: int) -> NDArray[np.float64]:
    """Draw positions in [-1, 1]², (entities, 2, m)."""
    return pcg64.uniform(pcg64.outputs(seeds, 2 * entities), -1.0, 1.0).reshape(entities, 2, -1)
