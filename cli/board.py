"""Boards of connect four and tic-tac-toe as text, from the planes that their observations hold."""

import numpy as np
from numpy.typing import NDArray

MARKS = ("●", "○")
EMPTY = "·"


def drawing(planes: NDArray) -> str | None:
    """`planes` (rows, columns, 2), whose first plane is drawn ● and whose second ○; None if they are no board."""
    if planes.ndim != 3 or planes.shape[2] != 2 or not np.isin(planes, (0, 1)).all():
        return None
    rows = [" ".join(_mark(square) for square in row) for row in planes]
    columns = " ".join(str(column) for column in range(planes.shape[1]))
    return "\n".join([*rows, columns])


def _mark(square: NDArray) -> str:
    return next((mark for mark, there in zip(MARKS, square, strict=True) if there), EMPTY)
