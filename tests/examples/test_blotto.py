import numpy as np
import pyspiel
import pytest
from hypothesis import given, settings
from pettingzoo.test import parallel_api_test

from league.config.environment import EnvironmentConfig
from league.results.equilibria import nash_averaging
from policy_league.examples.blotto import COINS, DIVISIONS, FIELDS, PAYOFF, Blotto, exploitability
from policy_league.examples.blotto_vector import BlottoVector
from tests.support.environments.plans import Plan, assert_equal, plans

CONFIG = EnvironmentConfig(entry_point="policy_league.examples.blotto:env")


@settings(max_examples=20)
@given(plans)
def test_the_vectorised_game_equals_the_stock_game(plan: Plan) -> None:
    assert_equal(CONFIG, BlottoVector(plan.num_envs), plan)


def test_payoffs_equal_those_of_open_spiel() -> None:
    game = pyspiel.load_game(f"blotto(coins={COINS},fields={FIELDS})")
    assert game.num_distinct_actions() == len(DIVISIONS)
    table = pyspiel.extensive_to_matrix_game(game)
    np.testing.assert_array_equal(np.array(table.row_utilities()), PAYOFF)


def test_only_a_mixed_policy_is_not_exploitable() -> None:
    assert exploitability(nash_averaging(PAYOFF)[0]) == pytest.approx(0, abs=1e-6)
    assert exploitability(np.eye(len(PAYOFF))[0]) == pytest.approx(1)


def test_pettingzoo_accepts_the_environment() -> None:
    parallel_api_test(Blotto(), num_cycles=10)
