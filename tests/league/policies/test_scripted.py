"""The scripted policies, compared with brute force on the real games."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pettingzoo.classic.rps.rps import raw_env as rps
from pettingzoo.classic.tictactoe.tictactoe import raw_env as tictactoe

from league.errors import EnvironmentMismatch, IllegalMask, InvalidInput, UnknownPolicy
from league.policies.policy import Policy
from league.policies.scripted import script
from league.spaces import Box, DictSpace, Discrete, MultiBinary, MultiDiscrete, Space
from league.spaces.conversion import to_gymnasium
from tests.support.environments.line_games import GAMES, environment_after, legal, observations, random_moves, spaces
from tests.support.examples import examples

DRAWS = 150
"""Enough draws for nine equally likely actions: the probability that one is missing is below 1e-6."""


def generators(rows: int, seed: int = 0) -> list[np.random.Generator]:
    return [np.random.default_rng((seed, row)) for row in range(rows)]


def winning_moves(game: str, moves: Sequence[int], own: bool) -> list[int]:
    """The actions with which the player to move wins immediately, or the opponent would if it were to move."""
    winning = []
    for action in legal(environment_after(game, moves)):
        env = environment_after(game, moves)
        if not own:
            env.agent_selection = env._agent_selector.next()
        player = env.agent_selection
        env.step(action)
        if env.rewards[player] == 1:
            winning.append(action)
    return winning


def chosen_actions(policy: Policy, env: Any) -> set[int]:
    """All actions that a script takes in a position."""
    return set(policy.act(observations([env] * DRAWS), rng=generators(DRAWS)).actions.tolist())


@examples(75)
@given(st.sampled_from(sorted(GAMES)), st.integers(0, 10_000), st.integers(0, 41))
def test_one_ply_wins_or_blocks_or_plays_any_legal_move(game: str, seed: int, plies: int) -> None:
    moves = random_moves(game, seed, plies)
    env = environment_after(game, moves)
    expected = winning_moves(game, moves, own=True) or winning_moves(game, moves, own=False) or legal(env)
    assert chosen_actions(script("one_ply", *spaces(env)), env) == set(expected)


@settings(max_examples=30, deadline=None)
@given(st.sampled_from(sorted(GAMES)), st.integers(0, 10_000), st.integers(0, 41))
def test_random_plays_exactly_the_legal_moves(game: str, seed: int, plies: int) -> None:
    env = environment_after(game, random_moves(game, seed, plies))
    assert chosen_actions(script("random", *spaces(env)), env) == set(legal(env))


@pytest.mark.parametrize("name", ["random", "one_ply", "mcts_100", "solver"])
def test_actions_do_not_depend_on_the_batch(name: str) -> None:
    envs = [environment_after("connect_four", random_moves("connect_four", seed, 3 * seed)) for seed in range(8)]
    policy = script(name, *spaces(envs[0]))
    batch = observations(envs)
    together = policy.act(batch, rng=generators(8)).actions
    for row in range(8):
        alone = {key: array[row : row + 1] for key, array in batch.items()}
        assert policy.act(alone, rng=generators(8)[row : row + 1]).actions == together[row]


def masked(actions: int, start: int = 0) -> tuple[Space, Space]:
    board = Box(dtype="int8", shape=(2,), low=0, high=1)
    mask = Box(dtype="int8", shape=(actions,), low=0, high=1)
    return DictSpace(spaces={"observation": board, "action_mask": mask}), Discrete(n=actions, start=start)


PAIR = MultiDiscrete(nvec=[2, 3], start=[0, 5], shape=(2,))


def test_first_takes_the_lowest_legal_action() -> None:
    for action, expected in (
        (Discrete(n=3, start=2), 2),
        (PAIR, [0, 5]),
        (MultiBinary(shape=(2,)), [0, 0]),
        (Box(dtype="float32", shape=(4,), low=[-2, 1, None, None], high=[5, 5, 5, -5]), [-2, 1, 0, -5]),
    ):
        actions = script("first", Discrete(n=4), action).act({"observation": np.zeros(3, np.int64)}).actions
        assert actions.tolist() == [expected] * 3
        assert all(to_gymnasium(action).contains(row) for row in actions)
    mask = np.array([[0, 1, 1, 0, 1], [1, 0, 0, 1, 1]], np.int8)
    batch = {"observation": mask, "action_mask": mask}
    assert script("first", *masked(5, start=10)).act(batch).actions.tolist() == [11, 10]
    assert script("first", masked(5)[0], PAIR).act(batch).actions.tolist() == [[1, 5], [0, 6]]
    with pytest.raises(IllegalMask, match="allows no action"):
        script("first", *masked(5)).act(batch | {"action_mask": mask * 0})


def test_unknown_scripts_and_unsupported_spaces_are_rejected(subtests: pytest.Subtests) -> None:
    with pytest.raises(UnknownPolicy, match=r"unknown script 'minimax'; known: random, one_ply, .*, solver"):
        script("minimax", *masked(3))
    board, three = spaces(tictactoe())[0], Discrete(n=3)
    for name, observation, action in (
        ("one_ply", *masked(7)),
        ("one_ply", Box(dtype="int8", shape=(6, 7, 2), low=0, high=1), Discrete(n=7)),
        ("one_ply", board, Discrete(n=8)),
        ("mcts_100", *masked(7)),
        ("solver", board, Discrete(n=8)),
        ("random", masked(5)[0], MultiDiscrete(nvec=[2, 2], start=[0, 0], shape=(2,))),
        ("random", masked(4)[0], Box(dtype="float32", shape=(4,), low=0, high=1)),
        ("first", masked(4)[0], Discrete(n=5)),
        ("first", three, DictSpace(spaces={"move": Discrete(n=2)})),
        ("mirror", three, three),
        ("mirror", Box(dtype="int8", shape=(4,), low=0, high=1), three),
        ("random", three, Box(dtype="float32", shape=(1,), low=None, high=1)),
        ("random", three, DictSpace(spaces={"move": Discrete(n=2)})),
    ):
        with subtests.test(name=name), pytest.raises(EnvironmentMismatch, match=f"script:{name}"):
            script(name, observation, action)
    # The games of OpenSpiel with the same names have other observations.
    message = "script:solver needs the spaces of PettingZoo's connect_four_v3 or tictactoe_v3"
    with pytest.raises(EnvironmentMismatch, match=message):
        script("solver", Box(dtype="float32", shape=(27,), low=0, high=1), Discrete(n=9))


def test_random_applies_the_mask_of_each_element() -> None:
    rows = 900
    policy = script("random", masked(5)[0], PAIR)
    mask = np.tile(np.array([0, 1, 1, 0, 1], np.int8), (rows, 1))
    actions = policy.act({"observation": mask, "action_mask": mask}, rng=generators(rows)).actions
    assert (actions[:, 0] == 1).all()
    assert set(actions[:, 1].tolist()) == {5, 7}
    assert abs((actions[:, 1] == 5).mean() - 0.5) < 5 * 0.5 / rows**0.5
    mask[3, 2:] = 0
    with pytest.raises(IllegalMask, match="allows no action"):
        policy.act({"observation": mask, "action_mask": mask}, rng=generators(rows))


def test_mirror_repeats_the_last_move_of_the_opponent() -> None:
    """In the real game: it starts with rock, then plays the previous move of the opponent."""
    env = rps()
    env.reset(seed=0)
    agent = env.possible_agents[1]
    policy = script("mirror", *spaces(env))
    moves, answers = [2, 1, 1, 0, 2], []
    for move in moves:
        env.step(move)
        observation = np.array([env.observe(agent)])
        answers.append(int(policy.act({"observation": observation}).actions[0]))
        env.step(answers[-1])
    assert answers == [0, *moves[:-1]]


@pytest.mark.parametrize("name", ["random", "one_ply", "mcts_100", "solver"])
def test_missing_generators_and_empty_masks_are_reported(name: str) -> None:
    policy = script(name, *spaces(tictactoe()))
    batch = {"observation": np.zeros((2, 3, 3, 2), np.int8), "action_mask": np.ones((2, 9), np.int8)}
    with pytest.raises(InvalidInput, match="2 rows needs rng, one generator per row: got none"):
        policy.act(batch)
    with pytest.raises(InvalidInput, match="2 rows needs rng, one generator per row: got 1"):
        policy.act(batch, rng=generators(1))
    nothing: Mapping[str, np.ndarray] = batch | {"action_mask": np.zeros((2, 9), np.int8)}
    with pytest.raises(IllegalMask, match="allows no action"):
        policy.act(nothing, rng=generators(2))


def test_random_without_a_mask_covers_the_space(subtests: pytest.Subtests) -> None:
    for action, low, high in (
        (Discrete(n=4, start=-1), -1, 2),
        (PAIR, [0, 5], [1, 7]),
        (MultiBinary(shape=(3,)), 0, 1),
        (Box(dtype="uint8", shape=(2,), low=3, high=5), 3, 5),
        (Box(dtype="float32", shape=(2,), low=[-1.0, 0.0], high=[1.0, 10.0]), [-1, 0], [1, 10]),
    ):
        with subtests.test(action=str(action)):
            policy = script("random", Box(dtype="float32", shape=(1,), low=0, high=1), action)
            actions = policy.act({"observation": np.zeros((1000, 1), np.float32)}, rng=generators(1000)).actions
            assert (actions.shape, actions.dtype) == ((1000, *action.shape), np.dtype(action.dtype))
            tolerance = 0.03 if action.dtype == "float32" else 0
            np.testing.assert_allclose(actions.min(axis=0), low, atol=tolerance)
            np.testing.assert_allclose(actions.max(axis=0), high, atol=tolerance)
            sampled = to_gymnasium(action)
            assert all(sampled.contains(row) for row in actions)
            np.testing.assert_allclose(actions.mean(axis=0), np.add(low, high) / 2, atol=0.25)
