"""Replay buffers with n-step returns that respect truncation; uniform, or prioritised by a sum tree.

A row is a transition: of one agent, between two of its own turns, or a joint one of all agents, whose columns have an
additional axis, plus the global state (see training/sampling/closed_transitions.py). The buffer interprets columns by
the prefixes of their names only:

| prefix | |
|---|---|
| `rewards` | summed over the steps of an n-step return, discounted |
| `terminated`, `truncated` | an n-step return ends with the first of an agent's ends |
| `next_` | taken, like those two, from the last step of an n-step return |
| all others | taken from its first step |

n-step returns are built when sampling, so that rows are stored once: each row refers to the following row of its stream
(one agent of one environment, or one environment). Following rows are newer, and are never overwritten earlier. A
return has fewer than n steps if the episode ends or the next row is unknown, because sampling stopped there or the
environment crashed. It is then bootstrapped earlier, which is equally valid: `discounts` is γ to the number of its
steps.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from league.config.off_policy import PrioritiesConfig
from league.random.seeds import generator


class SumTree:
    """A binary tree of priority sums; all leaves of a call are processed at once, level by level.

    Schaul et al., 2016, "Prioritized experience replay", arXiv 1511.05952, appendix B.2.1.
    """

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
        """Set the values of leaves (k,); the last value of a repeated leaf counts."""
        nodes = self._first + leaves
        self._nodes[nodes] = values
        for _ in range(self._depth):
            nodes = np.unique(nodes >> 1)
            self._nodes[nodes] = self._nodes[2 * nodes] + self._nodes[2 * nodes + 1]

    def get(self, leaves: NDArray) -> NDArray:
        """Return the values of leaves (k,)."""
        return self._nodes[self._first + leaves]

    def find(self, sums: NDArray) -> NDArray:
        """Return the leaves (k,) in which cumulative sums (k,), each in [0, total), lie."""
        nodes = np.ones(len(sums), dtype=np.int64)
        remainders = np.array(sums, dtype=np.float64)
        for _ in range(self._depth):
            nodes <<= 1
            left_sums, right_sums = self._nodes[nodes], self._nodes[nodes + 1]
            # Rounded sums may slightly exceed the total: never select a subtree of sum 0.
            goes_right = (remainders >= left_sums) & (right_sums > 0)
            remainders -= left_sums * goes_right
            nodes += goes_right
        return nodes - self._first


Column = TypeVar("Column")
Rows = dict[str, NDArray]
"""Column → (k, …)."""

REWARDS, NEXT, FLAGS = "rewards", "next_", ("terminated", "truncated")
DISCOUNTS = "discounts"
NO_ROW = -1
MIN_PRIORITY = 1e-3
"""Added to |error|, so that transitions with an error of 0 may be sampled again."""
ROWS_FILE, STATE_FILE = "rows.npz", "state.json"


@dataclass(frozen=True, slots=True)
class TransitionBlock:
    """Transitions on their way from a runner to a buffer.

    streams: (k,), the stream of each row; rows of a stream are in order. firsts: (k,) bool, whether a row has no
    predecessor: it is an episode's first, or the previous one was lost.
    """

    rows: Rows
    streams: NDArray
    firsts: NDArray

    def __len__(self) -> int:
        return len(self.streams)

    def newest(self, count: int) -> "TransitionBlock":
        """Return the last rows."""
        rows = {name: column[-count:] for name, column in self.rows.items()}
        return TransitionBlock(rows, self.streams[-count:], self.firsts[-count:])


@dataclass(frozen=True, slots=True)
class Sample:
    """k transitions of up to n steps each.

    rows: columns, with `discounts` (k,) float32, γ^m for m steps, also for terminated agents. indices: for updating
    priorities. weights: (k,) float32 importance weights, 1 if uniform; 0 for padding after the end of a sequence.
    """

    rows: Rows
    indices: NDArray
    weights: NDArray


class ReplayBuffer:
    """A ring buffer of transitions. Arrays are allocated at full capacity when the first rows are added."""

    def __init__(self, capacity: int, *, priorities: PrioritiesConfig | None = None, seed: int = 0) -> None:
        self.capacity = capacity
        self._priorities = priorities
        self._rng = generator(seed, "replay")
        self._columns: Rows = {}
        self._following = np.full(capacity, NO_ROW, dtype=np.int64)
        self._positions = np.zeros(capacity, dtype=np.int64)
        # Stream → its newest row, counted from the first row ever added.
        self._newest: dict[int, int] = {}
        self._added = 0
        self._tree = SumTree(capacity) if priorities else None
        self._largest = 1.0

    def __len__(self) -> int:
        return min(self._added, self.capacity)

    @property
    def added(self) -> int:
        """The number of rows ever added."""
        return self._added

    def reseed(self, seed: int, steps: int) -> None:
        """Derive all further sampling from `seed` and `steps`."""
        self._rng = generator(seed, "replay", steps)

    def add(self, block: TransitionBlock) -> None:
        """Add rows, replacing the oldest ones when full."""
        if not len(block):
            return
        if len(block) > self.capacity:
            block = block.newest(self.capacity)
        if not self._columns:
            self._columns = {name: np.zeros((self.capacity, *c.shape[1:]), c.dtype) for name, c in block.rows.items()}
        indices = (self._added + np.arange(len(block))) % self.capacity
        for name, column in block.rows.items():
            self._columns[name][indices] = column
        self._following[indices] = NO_ROW
        self._link(block)
        self._added += len(block)
        if self._tree is not None:
            self._tree.set(indices, self._largest)

    def sample(self, size: int, *, draws: int = 1, n_step: int = 1, gamma: float = 1.0, beta: float = 1.0) -> Sample:
        """Sample `size` transitions with replacement, `draws` times; return all draws, concatenated.

        Args:
            size: k.
            draws: The number of samples, each drawn as if alone.
            n_step: Maximum number of steps of the returns.
            gamma: Discount factor.
            beta: Exponent of the importance weights for prioritised replay (equation 1 and section 3.4 of Schaul et
            al.):
                w_i = (N P(i))^−β, divided by the largest of the sample.
        """
        if self._tree is None:
            indices = self._rng.integers(len(self), size=draws * size)
            weights = np.ones(draws * size, dtype=np.float32)
        else:
            # One row from each of k equal segments of the total, as in appendix B.2.1.
            places = np.arange(size) + self._rng.random((draws, size))
            indices = self._tree.find((places * (self._tree.total / size)).ravel())
            scaled = (self._tree.get(indices) * (len(self) / self._tree.total)) ** -beta
            scaled = scaled.reshape(draws, size)
            weights = (scaled / scaled.max(axis=1, keepdims=True)).astype(np.float32).ravel()
        return Sample(self.rows(indices, n_step=n_step, gamma=gamma), indices, weights)

    def sample_sequences(self, size: int, length: int, *, gamma: float = 1.0) -> Sample:
        """Sample, with replacement, `size` sequences of `length` consecutive rows of an episode.

        Sequences start at an episode's first row or a multiple of `length` after it; if the buffer contains no such
        row, anywhere. Returns size · length rows, concatenated sequences. If one ends early, its last row is repeated
        with weight 0.
        """
        starts = np.flatnonzero(self._positions[: len(self)] % length == 0)
        if not len(starts):
            starts = np.arange(len(self))
        indices = np.empty((size, length), dtype=np.int64)
        weights = np.ones((size, length), dtype=np.float32)
        indices[:, 0] = self._rng.choice(starts, size)
        for step in range(1, length):
            following = self._following[indices[:, step - 1]]
            weights[:, step] = weights[:, step - 1] * (following != NO_ROW)
            indices[:, step] = np.where(following != NO_ROW, following, indices[:, step - 1])
        return Sample(self.rows(indices.ravel(), gamma=gamma), indices.ravel(), weights.ravel())

    def rows(self, indices: NDArray, *, n_step: int = 1, gamma: float = 1.0) -> Rows:
        """Return the transitions that start at `indices`, (k,)."""
        lasts, steps, rewards = self._returns(indices, n_step, gamma)
        rows: Rows = {}
        for name, column in self._columns.items():
            if name.startswith(REWARDS):
                rows[name] = rewards[name]
            else:
                # Several times faster than indexing by arrays.
                rows[name] = column.take(lasts if name.startswith((NEXT, *FLAGS)) else indices, axis=0)
        rows[DISCOUNTS] = (gamma**steps).astype(np.float32)
        return rows

    def prioritize(self, indices: NDArray, errors: NDArray) -> None:
        """Set the priorities of rows (k,) to (|error| + MIN_PRIORITY)^α. Does nothing if uniform."""
        if self._tree is None or self._priorities is None:
            return
        values = (np.abs(errors.astype(np.float64)) + MIN_PRIORITY) ** self._priorities.alpha
        self._largest = max(self._largest, float(values.max()))
        self._tree.set(indices, values)

    def save(self, directory: Path) -> None:
        """Write everything but the random state, which `reseed` determines."""
        directory.mkdir(parents=True, exist_ok=True)
        size = len(self)
        kept = {f"column/{name}": column[:size] for name, column in self._columns.items()}
        kept |= {"following": self._following[:size], "positions": self._positions[:size]}
        kept |= {"streams": np.array([*self._newest, *self._newest.values()], dtype=np.int64)}
        if self._tree is not None:
            kept["priorities"] = self._tree.get(np.arange(size))
        np.savez_compressed(directory / ROWS_FILE, allow_pickle=False, **kept)
        state = {"capacity": self.capacity, "added": self._added, "largest": self._largest}
        (directory / STATE_FILE).write_text(json.dumps(state))

    def load(self, directory: Path) -> None:
        """Load what `save` wrote. The capacity must be the same."""
        state = json.loads((directory / STATE_FILE).read_text())
        assert state["capacity"] == self.capacity
        self._added, self._largest = state["added"], state["largest"]
        with np.load(directory / ROWS_FILE, allow_pickle=False) as kept:
            self._columns = {}
            for key in kept.files:
                if key.startswith("column/"):
                    rows = kept[key]
                    whole = np.zeros((self.capacity, *rows.shape[1:]), rows.dtype)
                    whole[: len(rows)] = rows
                    self._columns[key.removeprefix("column/")] = whole
            self._following[:] = NO_ROW
            self._following[: len(self)] = kept["following"]
            self._positions[: len(self)] = kept["positions"]
            streams, newest = np.split(kept["streams"], 2)
            self._newest = dict(zip(streams.tolist(), newest.tolist(), strict=True))
            if self._tree is not None:
                # Without saved priorities, all rows have the same.
                priorities = kept["priorities"] if "priorities" in kept.files else self._largest
                self._tree.set(np.arange(len(self)), priorities)

    def _link(self, block: TransitionBlock) -> None:
        """Store each row as the successor of the previous one in its stream, and its position in the episode."""
        number, oldest = self._added, self._added + len(block) - self.capacity
        for stream, is_first in zip(block.streams.tolist(), block.firsts.tolist(), strict=True):
            before = self._newest.get(stream, NO_ROW)
            if not is_first and before != NO_ROW and before >= oldest:
                self._following[before % self.capacity] = number % self.capacity
                position = self._positions[before % self.capacity] + 1
            else:
                position = 0
            self._positions[number % self.capacity] = position
            self._newest[stream] = number
            number += 1

    def _returns(self, indices: NDArray, n_step: int, gamma: float) -> tuple[NDArray, NDArray, Rows]:
        """Return the last row and the number of steps of each return, (k,), and the discounted reward sums, float32."""
        subcolumns = [name for name in self._columns if name.startswith(REWARDS)]
        rewards = {name: self._columns[name].take(indices, axis=0).astype(np.float32) for name in subcolumns}
        flags = [column for name, column in self._columns.items() if name.startswith(FLAGS)]
        lasts, steps = indices.copy(), np.ones(len(indices), dtype=np.int64)
        going = np.arange(len(indices))
        for step in range(1, n_step):
            following = self._following[lasts[going]]
            ends = [column[lasts[going]].reshape(len(going), -1) for column in flags]
            goes_on = (following != NO_ROW) & ~np.concatenate(ends, axis=1).any(axis=1)
            going, following = going[goes_on], following[goes_on]
            if not len(going):
                break
            for name in subcolumns:
                rewards[name][going] += gamma**step * self._columns[name][following]
            lasts[going] = following
            steps[going] += 1
        return lasts, steps, rewards


def saved_capacity(directory: Path) -> int:
    """Return the capacity of a buffer that was saved."""
    return int(json.loads((directory / STATE_FILE).read_text())["capacity"])


def subcolumns(rows: Mapping[str, Column], prefix: str) -> dict[str, Column]:
    """Return the columns under `prefix/`, without the prefix."""
    return {name.removeprefix(f"{prefix}/"): column for name, column in rows.items() if name.startswith(f"{prefix}/")}
