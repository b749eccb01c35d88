"""A bot for tic-tac-toe: it completes its own line, else blocks the opponent's, else prefers the centre."""

import numpy as np
from numpy.typing import NDArray

LINES = [(0, 1, 2), (3, 4, 5), (6, 7, 8), (0, 3, 6), (1, 4, 7), (2, 5, 8), (0, 4, 8), (2, 4, 6)]
PREFERRED = (4, 0, 2, 6, 8, 1, 3, 5, 7)


def act(observation: NDArray, action_mask: NDArray, rng: np.random.Generator) -> int:
    """Choose a square. observation: own and opponent's marks, (3, 3, 2)."""
    for marks in observation.reshape(9, 2).T:
        completing = [
            square
            for line in LINES
            for square in line
            if action_mask[square] and marks[list(line)].sum() == 2 and not marks[square]
        ]
        if completing:
            return int(rng.choice(completing))
    return next(square for square in PREFERRED if action_mask[square])
