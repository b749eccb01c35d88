"""A ring buffer of transitions in NumPy, uniform or prioritised, with n-step returns that respect truncation.

A row is a transition: of one agent, from one of its own turns to the next, or a joint one of all agents, whose columns
have an axis more, and the global state besides (training/sampling/closed.py makes both). The buffer knows columns by
what their names begin with, and nothing else of them:

| begins with | |
|---|---|
| `rewards` | summed over the steps of an n-step return, discounted |
| `terminated`, `truncated` | where an n-step return must end: as soon as one agent's episode does |
| `next_` | taken, with those two, from the last step of an n-step return |
| all others | taken from its first step |

n-step returns are made when sampling, so that rows are stored once and n is no property of the buffer: each row knows
the row that follows it in its stream (one agent of one copy, or one copy). Rows that follow are newer, and so are not
overwritten before it. A return has fewer than n steps where the episode ends or what follows is not known, because
sampling stopped there or the environment crashed; it is then bootstrapped earlier, which is right as well: `discounts`
has γ to the number of its steps.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from league.errors import ConfigError
from league.seeds import generator
from league.training_config import PrioritiesConfig
from training.sum_tree import SumTree

Column = TypeVar("Column")
Rows = dict[str, NDArray]
"""Column → (k, …)."""

REWARDS, NEXT, FLAGS = "rewards", "next_", ("terminated", "truncated")
DISCOUNTS = "discounts"
NONE = -1
SMALLEST_PRIORITY = 1e-3
"""Of an error of 0: what is learned well may be forgotten."""
ROWS_FILE, STATE_FILE = "rows.npz", "state.json"


@dataclass(frozen=True, slots=True)
class Block:
    """Transitions on their way from a runner to a buffer.

    streams: (k,) which stream each row is of, rows of one stream in their order. firsts: (k,) whether a row goes on
    from none before: it is an episode's first, or what was before was lost.
    """

    rows: Rows
    streams: NDArray
    firsts: NDArray

    def __len__(self) -> int:
        return len(self.streams)

    def newest(self, count: int) -> "Block":
        """Its last rows alone."""
        rows = {name: column[-count:] for name, column in self.rows.items()}
        return Block(rows, self.streams[-count:], self.firsts[-count:])


@dataclass(frozen=True, slots=True)
class Sample:
    """k transitions of n steps each, or fewer. rows: as above, with `discounts` (k,) float32: γ^m behind m steps, also
    where an agent terminated. indices: to give priorities to. weights: (k,) float32 of importance; 1 if uniform."""

    rows: Rows
    indices: NDArray
    weights: NDArray


class Replay:
    """Arrays are allocated when the first rows come, for all that will."""

    def __init__(self, capacity: int, *, priorities: PrioritiesConfig | None = None, seed: int = 0) -> None:
        self.capacity = capacity
        self._priorities = priorities
        self._rng = generator(seed, "replay")
        self._columns: Rows = {}
        self._following = np.full(capacity, NONE, dtype=np.int64)
        # Stream → its newest row, as the number of rows that were ever added before it.
        self._newest: dict[int, int] = {}
        self._added = 0
        self._tree = SumTree(capacity) if priorities else None
        self._largest = 1.0

    def __len__(self) -> int:
        return min(self._added, self.capacity)

    @property
    def added(self) -> int:
        """Rows that were ever added."""
        return self._added

    def reseed(self, seed: int, steps: int) -> None:
        """Derive what is drawn from here on from these alone."""
        self._rng = generator(seed, "replay", steps)

    def add(self, block: Block) -> None:
        """Take rows in, over the oldest ones where there is no room."""
        if not len(block):
            return
        if len(block) > self.capacity:
            block = block.newest(self.capacity)
        if not self._columns:
            self._columns = {name: np.zeros((self.capacity, *c.shape[1:]), c.dtype) for name, c in block.rows.items()}
        indices = (self._added + np.arange(len(block))) % self.capacity
        for name, column in block.rows.items():
            self._columns[name][indices] = column
        self._following[indices] = NONE
        self._link(block)
        self._added += len(block)
        if self._tree is not None:
            self._tree.set(indices, self._largest)

    def sample(self, size: int, *, n_step: int = 1, gamma: float = 1.0, beta: float = 1.0) -> Sample:
        """Draw `size` transitions with replacement.

        beta: of prioritised replay, how far weights make up for its probabilities (equation 1 and section 3.4 of
        Schaul et al.): w_i = (N P(i))^−β, divided by the largest of the sample.
        """
        if self._tree is None:
            indices = self._rng.integers(len(self), size=size)
            weights = np.ones(size, dtype=np.float32)
        else:
            # One draw from each of equal parts of the total, as in appendix B.2.1.
            indices = self._tree.find((np.arange(size) + self._rng.random(size)) * (self._tree.total / size))
            scaled = (self._tree.get(indices) * (len(self) / self._tree.total)) ** -beta
            weights = (scaled / scaled.max()).astype(np.float32)
        return Sample(self.rows(indices, n_step=n_step, gamma=gamma), indices, weights)

    def rows(self, indices: NDArray, *, n_step: int = 1, gamma: float = 1.0) -> Rows:
        """The transitions that begin at `indices` (k,)."""
        lasts, steps, rewards = self._returns(indices, n_step, gamma)
        found: Rows = {}
        for name, column in self._columns.items():
            if name.startswith(REWARDS):
                found[name] = rewards[name]
            else:
                found[name] = column[lasts if name.startswith((NEXT, *FLAGS)) else indices]
        found[DISCOUNTS] = (gamma**steps).astype(np.float32)
        return found

    def prioritize(self, indices: NDArray, errors: NDArray) -> None:
        """Sample rows (k,) in proportion to |error|^α from now on; nothing without priorities."""
        if self._tree is None or self._priorities is None:
            return
        values = (np.abs(errors.astype(np.float64)) + SMALLEST_PRIORITY) ** self._priorities.alpha
        self._largest = max(self._largest, float(values.max()))
        self._tree.set(indices, values)

    def save(self, directory: Path) -> None:
        """Write all but the random numbers' state, which `reseed` decides."""
        directory.mkdir(parents=True, exist_ok=True)
        size = len(self)
        kept = {f"column/{name}": column[:size] for name, column in self._columns.items()}
        kept |= {"following": self._following[:size]}
        kept |= {"streams": np.array([*self._newest, *self._newest.values()], dtype=np.int64)}
        if self._tree is not None:
            kept["priorities"] = self._tree.get(np.arange(size))
        np.savez_compressed(directory / ROWS_FILE, allow_pickle=False, **kept)
        state = {"capacity": self.capacity, "added": self._added, "largest": self._largest}
        (directory / STATE_FILE).write_text(json.dumps(state))

    def load(self, directory: Path) -> None:
        """Take over what `save` wrote. Raises ConfigError where that was of another capacity."""
        state = json.loads((directory / STATE_FILE).read_text())
        if state["capacity"] != self.capacity:
            raise ConfigError(
                f"training.replay_capacity: the checkpoint's buffer has {state['capacity']}, got {self.capacity}: take"
                " that, or leave the buffer behind by replay_in_checkpoint: false"
            )
        self._added, self._largest = state["added"], state["largest"]
        with np.load(directory / ROWS_FILE, allow_pickle=False) as kept:
            self._columns = {}
            for key in kept.files:
                if key.startswith("column/"):
                    rows = kept[key]
                    whole = np.zeros((self.capacity, *rows.shape[1:]), rows.dtype)
                    whole[: len(rows)] = rows
                    self._columns[key.removeprefix("column/")] = whole
            self._following[:] = NONE
            self._following[: len(self)] = kept["following"]
            streams, newest = np.split(kept["streams"], 2)
            self._newest = dict(zip(streams.tolist(), newest.tolist(), strict=True))
            if self._tree is not None:
                # Of a run without priorities so far, all rows count alike.
                known = kept["priorities"] if "priorities" in kept.files else self._largest
                self._tree.set(np.arange(len(self)), known)

    def _link(self, block: Block) -> None:
        """Let each row that goes on from one before be that one's successor."""
        number, oldest = self._added, self._added + len(block) - self.capacity
        for stream, is_first in zip(block.streams.tolist(), block.firsts.tolist(), strict=True):
            before = self._newest.get(stream, NONE)
            if not is_first and before != NONE and before >= oldest:
                self._following[before % self.capacity] = number % self.capacity
            self._newest[stream] = number
            number += 1

    def _returns(self, indices: NDArray, n_step: int, gamma: float) -> tuple[NDArray, NDArray, Rows]:
        """Of the returns that begin at `indices`: the rows (k,) of their last steps, how many steps they have, and the
        sums of the discounted rewards, float32."""
        names = [name for name in self._columns if name.startswith(REWARDS)]
        rewards = {name: self._columns[name][indices].astype(np.float32) for name in names}
        lasts, steps = indices.copy(), np.ones(len(indices), dtype=np.int64)
        going = np.arange(len(indices))
        for step in range(1, n_step):
            following = self._following[lasts[going]]
            goes_on = (following != NONE) & ~self._is_end(lasts[going])
            going, following = going[goes_on], following[goes_on]
            if not len(going):
                break
            for name in names:
                rewards[name][going] += gamma**step * self._columns[name][following]
            lasts[going] = following
            steps[going] += 1
        return lasts, steps, rewards

    def _is_end(self, indices: NDArray) -> NDArray:
        """(k,) whether an agent's episode ends with these rows."""
        ends = np.zeros(len(indices), dtype=bool)
        for name, column in self._columns.items():
            if name.startswith(FLAGS):
                ends |= column[indices].reshape(len(indices), -1).any(axis=1)
        return ends


def names(rows: Mapping[str, Column], prefix: str) -> dict[str, Column]:
    """The columns below `prefix/`, by the rest of their names."""
    return {name.removeprefix(f"{prefix}/"): column for name, column in rows.items() if name.startswith(f"{prefix}/")}
