"""Generated calls of a vectorised environment: idle copies, abandoned copies, seeds and actions."""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

from league.config.environment import EnvironmentConfig
from league.environments.equality import DifferentialTest
from league.environments.vector.random_actions import acting_rows
from league.environments.vector.vector_env import AgentRows, VectorEnv
from league.spaces import ACTION_MASK, Box, Discrete, Space

MAX_COPIES = 4


@dataclass(frozen=True)
class Phase:
    """Calls for the same copies. abandoned: those of them that start a new episode in the first call."""

    present: list[bool]
    abandoned: list[bool]
    calls: int


@dataclass(frozen=True)
class Plan:
    """The choices select among the legal actions, or between the bounds of a Box.

    Choices and seeds are repeated as often as necessary.
    """

    num_envs: int
    phases: list[Phase]
    choices: bytes
    seeds: list[int]


def copies(probable: bool) -> st.SearchStrategy[list[bool]]:
    mostly = st.just([probable] * MAX_COPIES)
    return mostly | st.lists(st.booleans(), min_size=MAX_COPIES, max_size=MAX_COPIES)


plans = st.builds(
    Plan,
    st.integers(1, MAX_COPIES),
    st.lists(st.builds(Phase, copies(True), copies(False), st.integers(1, 24)), min_size=1, max_size=8),
    st.binary(min_size=1, max_size=64),
    st.lists(st.integers(0, 2**31 - 1), min_size=1, max_size=6),
)


def assert_equal(config: EnvironmentConfig, vector: VectorEnv, plan: Plan) -> None:
    """Play a plan in a vectorised environment with `plan.num_envs` copies and Discrete or Box actions."""
    test = DifferentialTest(config, vector)
    ids, choices, seeds = np.arange(plan.num_envs), itertools.cycle(plan.choices), itertools.cycle(plan.seeds)
    for phase in plan.phases:
        present, abandoned = (np.array(flags[: plan.num_envs]) for flags in (phase.present, phase.abandoned))
        for call in range(phase.calls):
            starting = ids[present & (test.is_over | (abandoned & (call == 0)))]
            test.reset(starting, np.fromiter(seeds, np.int64, len(starting)))
            test.step(ids[present], chosen_actions(test, ids[present], choices))
    test.finish()
    test.close()


def last_rows(config: EnvironmentConfig, vector: VectorEnv, actions: list[int], seed: int = 0) -> AgentRows:
    """Play an episode of one copy, in the stock environment as well, and return its last rows."""
    test, copy = DifferentialTest(config, vector), np.zeros(1, dtype=np.int64)
    test.reset(copy, np.array([seed]))
    for action in actions:
        assert not test.is_over[0], "the episode is longer"
        test.step(copy, np.array([action]))
    assert test.is_over[0], "the episode is over"
    test.close()
    (rows,) = test.rows
    return rows


def chosen_actions(test: DifferentialTest, env_ids: NDArray[np.int64], choices: Iterator[int]) -> NDArray:
    return np.array(
        [
            chosen_action(test.actions[agent], mask, choices)
            for env in env_ids.tolist()
            for agent, mask in legal(test, env)
        ]
    )


def legal(test: DifferentialTest, env: int) -> list[tuple[int, NDArray | None]]:
    """Return the agents of a copy that must act, with their masks (n,); None for agents without a mask."""
    agents = {}
    for block in acting_rows(test.acting, np.array([env])):
        masks = block.observations.get(ACTION_MASK, [None] * len(block.envs))
        agents.update(zip(block.agents.tolist(), masks, strict=True))
    return sorted(agents.items())


def chosen_action(space: Space, mask: NDArray | None, choices: Iterator[int]) -> int | NDArray:
    if isinstance(space, Box):
        shares = np.fromiter(choices, np.uint8, int(np.prod(space.shape))) / 255
        low, high = np.array(space.low), np.array(space.high)
        return (low + (high - low) * shares.reshape(space.shape)).astype(space.dtype)
    assert isinstance(space, Discrete)
    legal = range(space.n) if mask is None else np.flatnonzero(mask)
    return int(legal[next(choices) % len(legal)])
