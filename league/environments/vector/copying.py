"""Tests whether episodes of a vectorised environment can be copied, restored from observations, and are without chance.

Search needs all three: it continues a game from its position with several actions, and expects the same outcome of the
same actions each time.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from league.environments.vector.differences import RowNames, check_reports, check_states
from league.environments.vector.random_actions import acting, acting_rows, random_steps
from league.environments.vector.vector_env import AgentRows, VectorEnv
from league.spaces import Space

ROUNDS, COPIES = 8, 32
LONGEST = 500
"""Steps after which a comparison ends."""

Repeat = Callable[[NDArray[np.int64], NDArray[np.int64], Sequence[AgentRows]], object]


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
        self._check("the copied episode", lambda copies, twins, _: self._env.copy(copies, twins))

    def check_restoring(self) -> None:
        """Check that episodes that are restored from observations continue identically.

        Raises also NotImplementedError, and ObservationError if a position of a game is not accepted.
        """
        self._check(
            "the restored episode",
            lambda _, twins, rows: [self._env.restore(twins, block.observations) for block in rows],
        )

    def check_without_chance(self) -> None:
        """Check that the same actions have the same outcome with each seed."""
        self._check("the episode with another seed")

    def _check(self, other: str, repeat: Repeat | None = None) -> None:
        """repeat: called with copies, their twins and the rows of the copies. None: the twins start alike."""
        env, every = self._env, np.arange(2 * COPIES)
        for _ in range(ROUNDS):
            seeds, copies = self._rng.integers(2**31, size=len(every)), every[:COPIES]
            where = RowNames(env.possible_agents, seeds, np.zeros(len(every), dtype=np.int64), other)
            every_row: Sequence[AgentRows] = env.reset(every, seeds)
            if repeat is not None:
                length = int(self._rng.integers(self._length))
                *_, every_row = every_row, *random_steps(env.step, every_row, self._actions, self._rng, length)
            rows = acting_rows(every_row, copies)
            if repeat is None:
                self._compare(where, copies, rows, acting_rows(every_row, copies + COPIES))
            else:
                repeat(acting(rows), acting(rows) + COPIES, rows)
            step = partial(self._step, where)
            steps = sum(1 for _ in random_steps(step, rows, self._actions, self._rng, LONGEST))
            self._length = max(self._length, steps)

    def _step(self, where: RowNames, copies: NDArray[np.int64], actions: NDArray) -> Sequence[AgentRows]:
        where.steps[copies] += 1
        rows, twins = (self._env.step(ids, actions.copy()) for ids in (copies, copies + COPIES))
        self._compare(where, copies, rows, twins)
        return rows

    def _compare(
        self, where: RowNames, copies: NDArray[np.int64], rows: Sequence[AgentRows], twins: Sequence[AgentRows]
    ) -> None:
        check_reports([replace(twin, envs=twin.envs - COPIES) for twin in twins], rows, where)
        check_states(self._env.state(copies + COPIES), self._env.state(copies), where, copies)
