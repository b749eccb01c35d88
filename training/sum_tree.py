"""A binary tree whose inner nodes are the sums of their children: draws leaves in proportion to their values."""

import numpy as np
from numpy.typing import NDArray


class SumTree:
    """Schaul et al., 2016, "Prioritized experience replay", arXiv 1511.05952, appendix B.2.1; all leaves of a call at
    once, level by level."""

    def __init__(self, leaves: int) -> None:
        self._depth = max(1, (leaves - 1).bit_length())
        self._first = 1 << self._depth
        # Node i has the children 2i and 2i + 1; the root is node 1, the leaves begin at `_first`.
        self._nodes = np.zeros(2 * self._first)

    @property
    def total(self) -> float:
        """The sum of all leaves."""
        return float(self._nodes[1])

    def set(self, leaves: NDArray, values: NDArray | float) -> None:
        """Give leaves (k,) their values; of a leaf that occurs twice, the last one counts."""
        nodes = self._first + leaves
        self._nodes[nodes] = values
        for _ in range(self._depth):
            nodes = np.unique(nodes >> 1)
            self._nodes[nodes] = self._nodes[2 * nodes] + self._nodes[2 * nodes + 1]

    def get(self, leaves: NDArray) -> NDArray:
        """(k,) values."""
        return self._nodes[self._first + leaves]

    def find(self, sums: NDArray) -> NDArray:
        """The leaves (k,) at which the running sum of values exceeds `sums` (k,), each in [0, total)."""
        nodes = np.ones(len(sums), dtype=np.int64)
        rest = np.array(sums, dtype=np.float64)
        for _ in range(self._depth):
            nodes <<= 1
            left, right = self._nodes[nodes], self._nodes[nodes + 1]
            # A sum of rounded numbers may exceed the total by a bit: never into what is worth nothing.
            goes_right = (rest >= left) & (right > 0)
            rest -= left * goes_right
            nodes += goes_right
        return nodes - self._first
