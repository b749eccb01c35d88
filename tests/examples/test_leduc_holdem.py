import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from pettingzoo.classic import leduc_holdem_v4
from pettingzoo.test import api_test, seed_test

from league.config.environment import EnvironmentConfig
from league.environments.vector.equality import compare
from policy_league.examples.leduc_holdem import MOST_ACTIONS, NUM_ACTIONS, ROUNDS, STOCK_SIZE, env
from policy_league.examples.leduc_holdem_vector import LeducWithHistoryVector
from tests.support.environments.plans import Plan, assert_equal, plans

CONFIG = EnvironmentConfig(entry_point="policy_league.examples.leduc_holdem:env")
CALL, RAISE, FOLD, CHECK = range(NUM_ACTIONS)


@settings(max_examples=40)
@given(plans)
def test_the_vectorised_game_equals_the_stock_game(plan: Plan) -> None:
    assert_equal(CONFIG, LeducWithHistoryVector(plan.num_envs), plan)


@pytest.mark.slow
def test_many_steps_of_the_vectorised_game_equal_those_of_the_stock_game() -> None:
    assert compare(CONFIG, LeducWithHistoryVector(256), 200_000, seed=1).difference is None


@pytest.mark.parametrize("seed", range(20))
def test_observations_are_those_of_pettingzoo_and_the_actions_of_both_rounds(seed: int) -> None:
    game, stock, rng = env(), leduc_holdem_v4.raw_env(), np.random.default_rng(seed)
    taken: list[list[int]] = [[], []]
    game.reset(seed=seed)
    stock.reset(seed=seed)
    while not any(game.terminations.values()):
        seen, expected = game.observe(game.agent_selection), stock.observe(stock.agent_selection)
        np.testing.assert_array_equal(seen["observation"][:STOCK_SIZE], expected["observation"])
        np.testing.assert_array_equal(seen["action_mask"], expected["action_mask"])
        history = seen["observation"][STOCK_SIZE:].reshape(ROUNDS, MOST_ACTIONS, NUM_ACTIONS)
        assert [[int(row.argmax()) for row in bets if row.any()] for bets in history] == taken
        action = int(rng.choice(np.flatnonzero(seen["action_mask"])))
        taken[int(expected["observation"][3:6].any())].append(action)
        game.step(action)
        stock.step(action)
    assert game.rewards == stock.rewards


def test_the_order_of_bets_is_visible() -> None:
    """Own 2 and the opponent's 4 chips: after a call and a raise, or a raise of the small blind."""
    seen = []
    for actions in ([CALL, RAISE], [RAISE]):
        game = env()
        game.reset(seed=0)
        for action in actions:
            game.step(action)
        seen.append(game.observe(game.agent_selection)["observation"])
    chips = [np.flatnonzero(each[6:STOCK_SIZE]).tolist() for each in seen]
    assert chips[0] == chips[1]
    assert (seen[0][STOCK_SIZE:] != seen[1][STOCK_SIZE:]).any()


def test_pettingzoo_accepts_the_environment() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it expects observations without a mask
        api_test(env(), num_cycles=50)
    seed_test(env)


def test_a_player_sees_the_back_of_the_opponents_card() -> None:
    game = env(render_mode="rgb_array")
    game.reset(seed=3)
    everything = game.render()
    views = {agent: game.render_for(agent) for agent in game.possible_agents}
    half = len(everything) // 2
    upper, lower = everything[:half], everything[half:]
    np.testing.assert_array_equal(views["player_0"][:half], upper)
    np.testing.assert_array_equal(views["player_1"][half:], lower)
    assert (views["player_0"][half:] != lower).any()
    assert (views["player_1"][:half] != upper).any()
    np.testing.assert_array_equal(game.render(), everything)
