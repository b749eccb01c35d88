"""Tests whether episodes of a vectorised environment can be copied, restored from observations, and are without chance.

Search needs all three: it continues a game from its position with several actions, and expects the same outcome of the
same actions each time.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from league.environments.vector.differences import RowNames, check_column, check_rows
from league.environments.vector.random_actions import legal_actions
from league.environments.vector.vector_env import AgentRows, VectorEnv
from league.spaces import Space

ROUNDS, COPIES = 8, 32
LONGEST = 500
"""Steps after which a comparison ends."""

Repeat = Callable[[NDArray[np.int64], NDArray[np.int64], Sequence[AgentRows]], None]


class Twins:
    """An environment whose second half of copies repeats the first half: each copy i has the twin i + half.

    Each method plays random legal actions in all copies for a while, lets the twins repeat the others in its own way,
    steps both with the same actions, and raises EnvironmentsDiffer, which names the first difference in one line.
    """

    def __init__(self, make: Callable[[int], VectorEnv], actions: Sequence[Space], seed: int = 0) -> None:
        """make: number of copies → environment. actions: action space of each agent. seed: of actions and episodes."""
        self._env, self._actions, self._rng = make(2 * COPIES), actions, np.random.default_rng(seed)
        self._length = 1

    def check_copying(self) -> None:
        """Check that copied episodes continue identically."""
        for _ in range(ROUNDS):
            self._check("the copied episode", lambda copies, twins, _: self._env.copy(copies, twins))

    def check_restoring(self) -> None:
        """Check that episodes that are restored from observations continue identically.

        Raises also NotImplementedError, and ObservationError if a position of a game is not accepted.
        """
        for _ in range(ROUNDS):
            self._check("the restored episode", self._restore)

    def check_without_chance(self) -> None:
        """Check that the same actions have the same outcome with each seed."""
        for _ in range(ROUNDS):
            self._check("the episode with another seed")

    def _restore(self, _: NDArray[np.int64], twins: NDArray[np.int64], rows: Sequence[AgentRows]) -> None:
        for block in rows:
            self._env.restore(twins, block.observations)

    def _check(self, other: str, repeat: Repeat | None = None) -> None:
        """repeat: called with copies, their twins and the rows of the copies. None: the twins start alike."""
        env, every = self._env, np.arange(2 * COPIES)
        seeds = self._rng.integers(2**31, size=len(every))
        where = RowNames(env.possible_agents, seeds, np.zeros(len(every), dtype=np.int64), other)
        rows: Sequence[AgentRows] = env.reset(every, seeds)
        copies = every[:COPIES]
        if repeat is None:
            self._compare(copies, _of(rows, copies), _of(rows, copies + COPIES), where)
            rows = _of(rows, copies)
        else:
            for _ in range(self._rng.integers(self._length)):
                rows = env.step(acting(rows), legal_actions(rows, self._actions, self._rng))
                if not len(acting(rows)):
                    break
            rows = _of(rows, copies)
            copies = acting(rows)
            repeat(copies, copies + COPIES, rows)
        steps = 0
        while len(copies) and steps < LONGEST:
            drawn = legal_actions(rows, self._actions, self._rng)
            where.steps[copies] += 1
            rows, twins = (env.step(ids, drawn.copy()) for ids in (copies, copies + COPIES))
            self._compare(copies, rows, twins, where)
            copies, steps = acting(rows), steps + 1
        self._length = max(self._length, steps)

    def _compare(
        self, copies: NDArray[np.int64], rows: Sequence[AgentRows], twins: Sequence[AgentRows], where: RowNames
    ) -> None:
        for block, twin in zip(rows, twins, strict=True):
            check_rows(replace(twin, envs=twin.envs - COPIES), block, where)
        state, twin_state = self._env.state(copies), self._env.state(copies + COPIES)
        if state is not None and twin_state is not None:
            check_column("state", twin_state, state, lambda row: where.text(int(copies[row])), where.other)


def acting(rows: Sequence[AgentRows]) -> NDArray[np.int64]:
    """Return the copies in which an agent must act, ascending."""
    return np.unique(np.concatenate([block.envs[~block.has_ended] for block in rows]))


def _of(rows: Sequence[AgentRows], copies: NDArray[np.int64]) -> list[AgentRows]:
    """Return the rows of some copies, without those of agents that have left."""
    return [block.take(np.flatnonzero(np.isin(block.envs, copies) & ~block.has_ended)) for block in rows]
