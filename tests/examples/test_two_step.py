import itertools
from typing import Any

import numpy as np
import pytest

from policy_league.examples.two_step import (
    AGENTS,
    FIRST,
    GAME_A,
    GAME_B,
    PAYOFFS,
    multi_agent_env,
    parallel_env,
    values,
)

GAMMA = 0.99


def play(env: Any, actions: tuple[tuple[int, int], ...]) -> tuple[list[float], list[bool], list[int]]:
    """Rewards and endings of an episode, step by step, and the states that both agents observe."""
    observations, _ = env.reset(seed=0)
    rewards, ends, states = [], [], [observations]
    for pair in actions:
        observations, paid, terminated, truncated, _ = env.step(dict(zip(AGENTS, pair, strict=True)))
        assert len(set(paid.values())) == 1, "both agents get the same reward"
        rewards.append(paid[AGENTS[0]])
        ends.append(terminated.get("__all__", terminated.get(AGENTS[0], False)))
        states.append(observations)
        assert not any(truncated.values())
    for seen in states:
        np.testing.assert_array_equal(seen[AGENTS[0]], seen[AGENTS[1]])
    return rewards, ends, [int(seen[AGENTS[0]].argmax()) for seen in states]


@pytest.mark.parametrize("make", [parallel_env, multi_agent_env])
def test_the_first_agent_selects_the_game_that_determines_the_rewards(make: Any) -> None:
    for first, other, a, b in itertools.product(range(2), repeat=4):
        rewards, ends, states = play(make(), ((first, other), (a, b)))
        game = GAME_B if first else GAME_A
        assert rewards == [0.0, float(PAYOFFS[game][a, b])]
        assert ends == [False, True]
        assert states[:2] == [FIRST, game]


def test_values_equal_the_paper_and_enumeration() -> None:
    found = values(GAMMA)
    np.testing.assert_allclose(found[FIRST], [[6.93, 6.93], [7.92, 7.92]])
    np.testing.assert_array_equal(found[GAME_A], np.full((2, 2), 7))
    np.testing.assert_array_equal(found[GAME_B], [[0, 1], [1, 8]])
    pairs = list(itertools.product(range(2), repeat=2))
    for pair in pairs:
        best = max(GAMMA * play(parallel_env(), (pair, later))[0][1] for later in pairs)
        assert found[FIRST][pair] == best


def test_the_best_sum_prefers_the_worse_game() -> None:
    """VDN's values of game B are its least-squares fit by Q_1(a) + Q_2(b): [[-1.5, 2.5], [2.5, 6.5]], so that the best
    expected value there is 6.5, less than 7.
    """
    rows = np.array([[a == 0, a == 1, b == 0, b == 1] for a in range(2) for b in range(2)], dtype=float)
    solution = np.linalg.lstsq(rows, PAYOFFS[GAME_B].ravel(), rcond=None)[0]
    fit = (rows @ solution).reshape(2, 2)
    np.testing.assert_allclose(fit, [[-1.5, 2.5], [2.5, 6.5]])
    assert fit.max() < PAYOFFS[GAME_A].max()


def test_both_apis_report_the_global_state() -> None:
    env = parallel_env()
    env.reset()
    assert env.state().tolist() == [1, 0, 0]
    env.step({AGENTS[0]: 1, AGENTS[1]: 0})
    assert env.state().tolist() == [0, 0, 1]
    assert env.state_space.contains(env.state())
    other = multi_agent_env()
    _, infos = other.reset()
    assert infos[AGENTS[0]]["state"].tolist() == [1, 0, 0]
