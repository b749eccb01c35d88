"""Differential test of a vectorised environment: the stock environment gets the same seeds and actions.

Everything that the two report must be equal bit for bit.
"""

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from functools import partial
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from league.config.environment import EnvironmentConfig
from league.environments.adapters import Report, adapter_for, splitter
from league.environments.building import agent_interface, build
from league.environments.vector.columns import agent_rows
from league.environments.vector.differences import EnvironmentsDiffer, RowNames, check_reports, check_states
from league.environments.vector.random_actions import acting, acting_rows, legal_actions
from league.environments.vector.vector_env import AgentRows, VectorEnv
from league.spaces import inputs
from league.spaces.arrays import environment_actions

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
        stock_seconds: Execution time of the stock copies and their adapters.
        rows: What the vectorised environment reported in the last call, without empty AgentRows.
        acting: The rows of all agents that must act.
        is_over: Whether no agent of a copy must act, (n,) bool. True before the first reset.
        steps: Environment steps so far.
        episodes: Episodes that were played to their end.
    """

    def __init__(self, config: EnvironmentConfig, vector: VectorEnv) -> None:
        self._vector = vector
        with ExitStack() as created:
            envs = [created.enter_context(closing(build(config))) for _ in range(vector.num_envs)]
            interfaces = {agent: agent_interface(envs[0], agent) for agent in envs[0].possible_agents}
            splits = [splitter(spaces.observation) for spaces in interfaces.values()]
            self._stock = [adapter_for(env, splits) for env in envs]
            created.pop_all()
        self._agents, self.actions = tuple(interfaces), [spaces.action for spaces in interfaces.values()]
        leaves = [inputs(spaces.observation) for spaces in interfaces.values()]
        self._first_alike = [leaves.index(agent_leaves) for agent_leaves in leaves]
        self._rows = partial(agent_rows, self._agents, leaves, self._first_alike)
        self._seeds, self._steps = np.zeros((2, vector.num_envs), dtype=np.int64)
        self.is_over, self.stock_seconds = np.ones(vector.num_envs, dtype=bool), 0.0
        self.rows: list[AgentRows] = []
        self.acting: list[AgentRows] = []
        self._earlier: deque[tuple[Sequence[AgentRows], Sequence[AgentRows], RowNames]] = deque()
        self.steps, self.episodes = 0, 0

    def reset(self, envs: NDArray[np.int64], seeds: NDArray[np.int64]) -> None:
        """Reset some copies of both. No call if `envs` is empty."""
        self._seeds[envs], self._steps[envs] = seeds, 0
        self._call(envs, self._vector.reset, seeds, lambda env: self._stock[env].reset(int(self._seeds[env])))

    def step(self, envs: NDArray[np.int64], actions: NDArray) -> None:
        """Step some copies of both. actions: as for VectorEnv.step. No call if `envs` is empty."""
        blocks, agents = acting_rows(self.acting, envs), len(self._agents)
        places = np.sort(np.concatenate([envs[:0], *(block.envs * agents + block.agents for block in blocks)]))
        moves: dict[int, list[tuple[int, Any]]] = {env: [] for env in envs.tolist()}
        for place, action in zip(places.tolist(), environment_actions(actions, self.actions[0]), strict=True):
            moves[place // agents].append((place % agents, action))
        self._steps[envs] += 1
        self._call(envs, self._vector.step, actions, lambda env: self._stock[env].step(moves[env]))
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
        for env in self._stock:
            env.close()

    def _call(
        self,
        envs: NDArray[np.int64],
        call: Callable[[NDArray[np.int64], NDArray], Sequence[AgentRows]],
        values: NDArray,
        stock_call: Callable[[int], list[Report]],
    ) -> None:
        if not len(envs):
            return
        began = perf_counter()
        reports = {env: stock_call(env) for env in envs.tolist()}
        self.stock_seconds += perf_counter() - began
        expected, lent = self._rows(reports), values.copy()
        self.rows = [block for block in call(envs.copy(), lent) if len(block.envs)]
        # The caller may reuse its arrays: a reference in the environment's state would be a fault.
        lent[...] = 0
        if (agents := tuple(self._vector.possible_agents)) != self._agents:
            raise EnvironmentsDiffer(f"possible_agents is {agents}, in the stock environment {self._agents}")
        where = RowNames(agents, self._seeds.copy(), self._steps.copy())
        check_reports(expected, self.rows, where)
        states = [self._stock[env].state() for env in envs]
        expected_states = None if states[0] is None else np.array([np.ravel(state) for state in states], np.float32)
        check_states(expected_states, self._vector.state(envs.copy()), where, envs)
        self._earlier.append((expected, self.rows, where))
        self.finish(KEPT)
        copies = np.arange(len(self.is_over))
        resting = acting_rows(self.acting, np.setdiff1d(copies, envs))
        self.acting = AgentRows.of_spaces(resting + acting_rows(self.rows), self._first_alike)
        self.is_over = ~np.isin(copies, acting(self.acting))
