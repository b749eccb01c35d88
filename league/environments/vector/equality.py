"""Differential test of a vectorised environment: the stock environment gets the same seeds and actions.

Everything that the two report must be equal bit for bit.
"""

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from functools import partial
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from league.config.environment import EnvironmentConfig
from league.environments.adapters import Report, adapter_for
from league.environments.building import agent_interface, build
from league.environments.vector.differences import EnvironmentsDiffer, RowNames, check_column, check_rows
from league.environments.vector.random_actions import random_actions
from league.environments.vector.vector_env import AgentRows, VectorEnv
from league.spaces import ACTION_MASK, Space, inputs
from league.spaces.arrays import environment_actions, tensors

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
        vector_rate: Environment steps per second of the vectorised environment, including resets. Many calls have few
            copies, so that it is lower than in training.
        stock_rate: The same of the stock environment, including the adapter.
    """

    steps: int
    episodes: int
    difference: str | None
    vector_rate: float
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
            test.step(stepped, test.random_actions(stepped, rng))
            if test.steps >= steps:
                break
        test.finish()
    except EnvironmentsDiffer as found:
        difference = str(found)
    finally:
        test.close()
    rates = (test.steps / seconds if seconds else 0.0 for seconds in (test.vector_seconds, test.stock_seconds))
    return Comparison(test.steps, test.episodes, difference, *rates)


def _schedule(test: "DifferentialTest", rng: np.random.Generator) -> Iterator[tuple[NDArray, NDArray]]:
    """Yield the copies of the next reset and of the step after it. Every other phase, all copies take part."""
    copies = np.arange(test.num_envs)
    while True:
        for some in (False, True):
            awake = rng.random(test.num_envs) < rng.random() if some else np.ones(test.num_envs, dtype=bool)
            share = rng.choice([0.2, 0.8, 1.0]) if some else 1.0
            for _ in range(rng.integers(1, LONGEST_PHASE)):
                present = awake & (rng.random(test.num_envs) < share)
                starting = present & (test.is_over | (rng.random(test.num_envs) < ABANDONED))
                yield copies[starting], copies[present & (starting | ~test.is_over)]


def _seeds(count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    seeds = rng.integers(0, MAX_SEED, size=count, endpoint=True)
    extreme = rng.choice([0, 1, MAX_SEED], size=count)
    return np.where(rng.random(count) < 0.05, extreme, seeds)


class _Agent(NamedTuple):
    """An agent of the stock environment. block: index of its observation space among the different ones."""

    name: str
    observation: Space
    action: Space
    block: int


class DifferentialTest:
    """A vectorised environment and as many copies of its stock environment.

    Each call resets or steps the same copies of both. It raises EnvironmentsDiffer at the first report that is not
    equal.

    Attributes:
        rows: What the vectorised environment reported in the last call, without empty AgentRows.
        is_over: Whether no agent of a copy must act, (num_envs,) bool. True before the first reset.
        steps: Environment steps so far.
        episodes: Episodes that were played to their end.
        vector_seconds: Execution time of the vectorised environment.
        stock_seconds: Execution time of the stock copies and their adapters.
    """

    def __init__(self, config: EnvironmentConfig, vector: VectorEnv) -> None:
        self._vector, self.num_envs = vector, vector.num_envs
        with ExitStack() as created:
            stock = [created.enter_context(closing(build(config))) for _ in range(self.num_envs)]
            self._agents = _agents(stock[0])
            splits = [partial(tensors, agent.observation) for agent in self._agents]
            self._stock = [adapter_for(env, splits) for env in stock]
            created.pop_all()
        self._seeds, self._steps = np.zeros((2, self.num_envs), dtype=np.int64)
        self._must_act = np.zeros((self.num_envs, len(self._agents)), dtype=bool)
        self._masks: dict[int, NDArray] = {}
        self._earlier: deque[Callable[[], None]] = deque()
        self.is_over: NDArray[np.bool_] = np.ones(self.num_envs, dtype=bool)
        self.rows: list[AgentRows] = []
        self.steps, self.episodes = 0, 0
        self.vector_seconds, self.stock_seconds = 0.0, 0.0

    def reset(self, env_ids: NDArray[np.int64], seeds: NDArray[np.int64]) -> None:
        """Reset some copies of both. No call if `env_ids` is empty."""
        self._seeds[env_ids], self._steps[env_ids] = seeds, 0
        self._call(env_ids, self._vector.reset, seeds, lambda row, env: self._stock[env].reset(int(seeds[row])))

    def step(self, env_ids: NDArray[np.int64], actions: NDArray) -> None:
        """Step some copies of both. actions: as for VectorEnv.step. No call if `env_ids` is empty."""
        acting = self._must_act[env_ids]
        action_iterator = iter(environment_actions(actions, self._agents[0].action))
        moves = [[(int(agent), next(action_iterator)) for agent in np.flatnonzero(row)] for row in acting]
        self._steps[env_ids] += 1
        self._call(env_ids, self._vector.step, actions, lambda row, env: self._stock[env].step(moves[row]))
        self.steps += len(env_ids)
        self.episodes += int(self.is_over[env_ids].sum())

    def legal(self, env: int) -> list[tuple[int, NDArray | None]]:
        """Return the agents of a copy that must act, with their masks (n,); None for agents without a mask."""
        return [
            (agent, self._masks[agent][env] if agent in self._masks else None)
            for agent in np.flatnonzero(self._must_act[env]).tolist()
        ]

    def action_space(self, agent: int) -> Space:
        """Return the action space of an agent."""
        return self._agents[agent].action

    def random_actions(self, env_ids: NDArray[np.int64], rng: np.random.Generator) -> NDArray:
        """Draw legal actions for all agents of some copies that must act, in the order of VectorEnv.step."""
        drawn, places = [], []
        for index, agent in enumerate(self._agents):
            envs = env_ids[self._must_act[env_ids, index]]
            mask = self._masks[index][envs] if index in self._masks else None
            drawn.append(random_actions(agent.action, len(envs), mask, rng))
            places.append(envs * len(self._agents) + index)
        return np.concatenate(drawn)[np.argsort(np.concatenate(places))]

    def finish(self) -> None:
        """Check that the last reports are still unchanged."""
        while self._earlier:
            self._earlier.popleft()()

    def close(self) -> None:
        """Close the stock copies."""
        for env in self._stock:
            env.close()

    def _call(
        self,
        env_ids: NDArray[np.int64],
        call: Callable[[NDArray[np.int64], NDArray], Sequence[AgentRows]],
        given: NDArray,
        stock_call: Callable[[int, int], list[Report]],
    ) -> None:
        if not len(env_ids):
            return
        began = perf_counter()
        reports = [(int(env), report) for row, env in enumerate(env_ids) for report in stock_call(row, env)]
        self.stock_seconds += perf_counter() - began
        lent = given.copy()
        began = perf_counter()
        blocks = call(env_ids.copy(), lent)
        self.vector_seconds += perf_counter() - began
        # The caller may reuse its arrays: a reference in the environment's state would be a fault.
        lent[...] = 0
        self._must_act[env_ids] = False
        self._check_reports(self._stock_blocks(reports), blocks)
        self._check_states(env_ids)
        self.is_over[env_ids] = ~self._must_act[env_ids].any(axis=1)

    def _stock_blocks(self, reports: Sequence[tuple[int, Report]]) -> list[AgentRows]:
        """Sort reports of the stock environment into one AgentRows for each observation space, without empty ones."""
        blocks: dict[int, list[tuple[int, Report]]] = {}
        for env, report in reports:
            agent, observation, _, terminated, truncated = report
            blocks.setdefault(self._agents[agent].block, []).append((env, report))
            self._must_act[env, agent] = not (terminated or truncated)
            if ACTION_MASK in observation:
                mask = observation[ACTION_MASK]
                self._masks.setdefault(agent, np.zeros((self.num_envs, *mask.shape), mask.dtype))[env] = mask
        return [_columns(self._space(block), blocks[block]) for block in sorted(blocks)]

    def _space(self, block: int) -> Space:
        return next(agent.observation for agent in self._agents if agent.block == block)

    def _check_reports(self, expected: list[AgentRows], reported: Sequence[AgentRows]) -> None:
        names = tuple(agent.name for agent in self._agents)
        if (agents := tuple(self._vector.possible_agents)) != names:
            raise EnvironmentsDiffer(f"possible_agents is {agents}, in the stock environment {names}")
        self.rows = blocks = [rows for rows in reported if len(rows.envs)]
        if len(blocks) != len(expected):
            raise EnvironmentsDiffer(
                f"{len(blocks)} AgentRows have rows, expected {len(expected)}: one per observation space"
            )
        where = RowNames(names, self._seeds.copy(), self._steps.copy())
        for stock, vector in zip(expected, blocks, strict=True):
            check_rows(stock, vector, where)

        def check_unchanged() -> None:
            try:
                for stock, vector in zip(expected, blocks, strict=True):
                    check_rows(stock, vector, where)
            except EnvironmentsDiffer as difference:
                raise EnvironmentsDiffer(f"{difference} (changed after it was reported)") from None

        self._earlier.append(check_unchanged)
        if len(self._earlier) > KEPT:
            self._earlier.popleft()()

    def _check_states(self, env_ids: NDArray[np.int64]) -> None:
        states, vector = [self._stock[env].state() for env in env_ids], self._vector.state(env_ids.copy())
        if states[0] is None:
            if vector is not None:
                raise EnvironmentsDiffer("the environment has a state, the stock environment has none")
            return
        stock = np.array([np.asarray(state, dtype=np.float32).ravel() for state in states])
        where = RowNames([agent.name for agent in self._agents], self._seeds, self._steps)
        if vector is None:
            raise EnvironmentsDiffer("the environment has no state, but the stock environment has one")
        check_column("state", stock, vector, lambda row: where.text(int(env_ids[row])))


def _agents(env: Any) -> list[_Agent]:
    spaces: list[Space] = []
    agents = []
    for name in env.possible_agents:
        interface = agent_interface(env, name)
        if interface.observation not in spaces:
            spaces.append(interface.observation)
        agents.append(_Agent(name, interface.observation, interface.action, spaces.index(interface.observation)))
    return agents


def _columns(space: Space, reports: Sequence[tuple[int, Report]]) -> AgentRows:
    envs = [env for env, _ in reports]
    agents, observations, rewards, terminations, truncations = zip(*(report for _, report in reports), strict=True)
    return AgentRows(
        np.array(envs, dtype=np.int64),
        np.array(agents, dtype=np.int64),
        {name: np.array([row[name] for row in observations], dtype=leaf.dtype) for name, leaf in inputs(space).items()},
        np.array(rewards, dtype=np.float64),
        np.array(terminations, dtype=bool),
        np.array(truncations, dtype=bool),
    )
