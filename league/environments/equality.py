"""Differential test of a vectorised environment: the stock environment gets the same seeds and actions.

Everything that the two report must be equal bit for bit.
"""

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from league.config.environment import EnvironmentConfig
from league.environments.building import build
from league.environments.copies import StockCopies
from league.environments.stepping import Batch
from league.environments.vector.differences import EnvironmentsDiffer, RowNames, check_reports, check_states
from league.environments.vector.random_actions import acting, acting_rows, legal_actions
from league.environments.vector.vector_env import AgentRows, VectorEnv

MAX_SEED = 2**31 - 1
LONGEST_PHASE = 40
"""Maximum number of calls with the same idle copies."""
ABANDONED = 0.003
"""Probability that a copy abandons its episode, for each call."""
KEPT = 3
"""Number of calls after which reports must still be unchanged."""


@dataclass(frozen=True, slots=True)
class Comparison:
    """Result of `compare`.

    Attributes:
        steps: Environment steps that were compared, resets not included.
        episodes: Episodes that were played to their end.
        difference: The first difference, in one line. None if all reports are equal.
        stock_rate: Environment steps per second of the stock environment, including resets and the adapter.
    """

    steps: int
    episodes: int
    difference: str | None
    stock_rate: float


def compare(config: EnvironmentConfig, vector: VectorEnv, steps: int, seed: int) -> Comparison:
    """Play random legal actions until `steps` environment steps were compared, or until the first difference.

    Copies rest for a number of calls, take part in random calls only, and abandon episodes. The copies of `vector` may
    be in any state. Exceptions of the environments are not caught.
    """
    test = DifferentialTest(config, vector)
    rng = np.random.default_rng(seed)
    difference = None
    try:
        for starting, stepped in _schedule(test, rng):
            test.reset(starting, _seeds(len(starting), rng))
            test.step(stepped, legal_actions(acting_rows(test.acting, stepped), test.actions, rng))
            if test.steps >= steps:
                break
        test.finish()
    except EnvironmentsDiffer as found:
        difference = str(found)
    finally:
        test.close()
    rate = test.steps / test.stock_seconds if test.stock_seconds else 0.0
    return Comparison(test.steps, test.episodes, difference, rate)


def _schedule(test: "DifferentialTest", rng: np.random.Generator) -> Iterator[tuple[NDArray, NDArray]]:
    """Yield the copies of the next reset and of the step after it. Every other phase, all copies take part."""
    copies = np.arange(num_envs := len(test.is_over))
    while True:
        for some in (False, True):
            awake = rng.random(num_envs) < rng.random() if some else np.ones(num_envs, dtype=bool)
            share = rng.choice([0.2, 0.8, 1.0]) if some else 1.0
            for _ in range(rng.integers(1, LONGEST_PHASE)):
                present = awake & (rng.random(num_envs) < share)
                starting = present & (test.is_over | (rng.random(num_envs) < ABANDONED))
                if len(stepped := copies[present & (starting | ~test.is_over)]):
                    yield copies[starting], stepped


def _seeds(count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    seeds = rng.integers(0, MAX_SEED, size=count, endpoint=True)
    extreme = rng.choice([0, 1, MAX_SEED], size=count)
    return np.where(rng.random(count) < 0.05, extreme, seeds)


class DifferentialTest:
    """A vectorised environment and as many copies of its stock environment.

    Each call resets or steps the same copies of both. It raises EnvironmentsDiffer at the first report that is not
    equal.

    Attributes:
        actions: Action space of each agent.
        rows: What the vectorised environment reported in the last call, without empty AgentRows.
        acting: The rows of all agents that must act.
        is_over: Whether no agent of a copy must act, (n,) bool. True before the first reset.
        steps: Environment steps so far.
        episodes: Episodes that were played to their end.
    """

    def __init__(self, config: EnvironmentConfig, vector: VectorEnv) -> None:
        self._vector = vector
        self._stock = StockCopies(partial(build, config), vector.num_envs)
        self.actions = self._stock.actions
        self._steps = np.zeros(vector.num_envs, dtype=np.int64)
        self.is_over = np.ones(vector.num_envs, dtype=bool)
        self.rows: list[AgentRows] = []
        self.acting: list[AgentRows] = []
        self._earlier: deque[tuple[Sequence[AgentRows], Sequence[AgentRows], RowNames]] = deque()
        self.steps, self.episodes = 0, 0

    @property
    def stock_seconds(self) -> float:
        """Execution time of the stock copies and their adapters."""
        return float(self._stock.seconds.sum())

    def reset(self, envs: NDArray[np.int64], seeds: NDArray[np.int64]) -> None:
        """Reset some copies of both. No call if `envs` is empty."""
        if len(envs):
            self._stock.seeds[envs], self._steps[envs] = seeds, 0
            self._compare(envs, self._stock.reset(envs), self._vector.reset, seeds)

    def step(self, envs: NDArray[np.int64], actions: NDArray) -> None:
        """Step some copies of both. actions: as for VectorEnv.step. No call if `envs` is empty."""
        if not len(envs):
            return
        places = [block.envs * len(self.actions) + block.agents for block in acting_rows(self.acting, envs)]
        acting_envs, agents = np.divmod(np.sort(np.concatenate(places)), len(self.actions))
        self._steps[envs] += 1
        rows, _ = self._stock.step(envs, {0: Batch(acting_envs, agents, {}, np.zeros(len(agents)))}, {0: actions})
        self._compare(envs, rows, self._vector.step, actions)
        self.steps += len(envs)
        self.episodes += int(self.is_over[envs].sum())

    def finish(self, kept: int = 0) -> None:
        """Check that the last reports, or all of them but the newest `kept`, are still unchanged."""
        while len(self._earlier) > kept:
            try:
                check_reports(*self._earlier.popleft())
            except EnvironmentsDiffer as difference:
                raise EnvironmentsDiffer(f"{difference} (changed after it was reported)") from None

    def close(self) -> None:
        """Close the stock copies."""
        self._stock.close()

    def _compare(
        self,
        envs: NDArray[np.int64],
        expected: Sequence[AgentRows],
        call: Callable[[NDArray[np.int64], NDArray], Sequence[AgentRows]],
        values: NDArray,
    ) -> None:
        lent = values.copy()
        self.rows = [block for block in call(envs.copy(), lent) if len(block.envs)]
        # The caller may reuse its arrays: a reference in the environment's state would be a fault.
        lent[...] = 0
        if (agents := tuple(self._vector.possible_agents)) != self._stock.agents:
            raise EnvironmentsDiffer(f"possible_agents is {agents}, in the stock environment {self._stock.agents}")
        where = RowNames(agents, self._stock.seeds.copy(), self._steps.copy())
        check_reports(expected, self.rows, where)
        check_states(self._stock.states(envs), self._vector.state(envs.copy()), where, envs)
        self._earlier.append((expected, self.rows, where))
        self.finish(KEPT)
        copies = np.arange(len(self.is_over))
        resting = acting_rows(self.acting, np.setdiff1d(copies, envs))
        self.acting = AgentRows.of_spaces(resting + acting_rows(self.rows), self._stock.first_alike)
        self.is_over = ~np.isin(copies, acting(self.acting))
