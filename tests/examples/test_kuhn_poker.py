import itertools
import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pettingzoo.test import api_test, seed_test

from league.config.environment import EnvironmentConfig
from league.environments.vector.equality import compare
from league.random import splitmix64
from policy_league.examples.kuhn_poker import BET, DEALS, PASS, KuhnPoker, env
from policy_league.examples.kuhn_poker_vector import KuhnPokerVector
from tests.support.environments.plans import Plan, assert_equal, last_rows, plans

CONFIG = EnvironmentConfig(entry_point="policy_league.examples.kuhn_poker")

LINES = {
    (PASS, PASS): ("showdown", 1),
    (BET, BET): ("showdown", 2),
    (PASS, BET, BET): ("showdown", 2),
    (BET, PASS): ("first wins", 1),
    (PASS, BET, PASS): ("second wins", 1),
}
"""All betting lines: who wins, and how much."""


@settings(max_examples=60)
@given(plans)
def test_the_vectorised_game_equals_the_stock_game(plan: Plan) -> None:
    assert_equal(CONFIG, KuhnPokerVector(plan.num_envs), plan)


@pytest.mark.slow
def test_many_steps_of_the_vectorised_game_equal_those_of_the_stock_game() -> None:
    found = compare(CONFIG, KuhnPokerVector(256), 200_000, seed=1)
    assert found.difference is None
    assert found.episodes > 60_000


def cards(seed: int) -> tuple[int, int]:
    """The deal of a seed, read from the observations of the stock game."""
    game = KuhnPoker()
    game.reset(seed=seed)
    first, second = (int(game.observe(agent)["observation"][2:5].argmax()) for agent in game.possible_agents)
    return first, second


SEEDS = {cards(seed): seed for seed in range(100)}
"""Deal → a seed."""


@pytest.mark.parametrize(("deal", "line"), itertools.product(DEALS, LINES), ids=str)
def test_each_deal_and_line_is_paid(deal: tuple[int, int], line: tuple[int, ...]) -> None:
    rows = last_rows(CONFIG, KuhnPokerVector(1), list(line), SEEDS[deal])
    kind, stake = LINES[line]
    first_wins = kind == "first wins" or (kind == "showdown" and deal[0] > deal[1])
    of_first = stake if first_wins else -stake
    # The row of the player whose turn it would be comes first.
    next_player = len(line) % 2
    assert rows.agents.tolist() == [next_player, 1 - next_player]
    assert rows.rewards.tolist() == [of_first if agent == 0 else -of_first for agent in rows.agents]
    assert rows.terminations.all()
    for agent, observation in zip(rows.agents, rows.observations["observation"], strict=True):
        line_seen = observation[5:].reshape(3, 2)[: len(line)].argmax(axis=1).tolist()
        assert (observation[:2].argmax(), observation[2:5].argmax(), line_seen) == (agent, deal[agent], list(line))


def test_all_deals_are_equally_probable() -> None:
    (rows,) = KuhnPokerVector(60_000).reset(np.arange(60_000), np.arange(60_000))
    dealt = rows.observations["observation"][:, 2:5].sum(axis=0)
    # Six standard deviations of a binomial distribution.
    assert (abs(dealt - 20_000) < 6 * np.sqrt(60_000 * 2 / 9)).all()


def test_fast_deals_have_exactly_the_distribution_of_the_game(monkeypatch: pytest.MonkeyPatch) -> None:
    """All outcomes of the generator are enumerated: each deal has one."""
    monkeypatch.setattr(splitmix64, "outputs", lambda _, numbers: numbers.astype(np.uint64))
    game, copies = KuhnPokerVector(len(DEALS)), np.arange(len(DEALS))
    game.use_fast_seeds()
    (first,) = game.reset(copies, copies)
    (second,) = game.step(copies, np.full(len(DEALS), BET))
    dealt = [rows.observations["observation"][:, 2:5].argmax(axis=1).tolist() for rows in (first, second)]
    assert sorted(zip(*dealt, strict=True)) == sorted(DEALS)


@given(st.integers(0, 2**31 - 1))
def test_vectorised_deals_are_those_of_numpy(seed: int) -> None:
    (rows,) = KuhnPokerVector(1).reset(np.zeros(1, dtype=np.int64), np.array([seed]))
    assert rows.observations["observation"][0, 2:5].argmax() == cards(seed)[0]


def test_pettingzoo_accepts_the_environment() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it expects observations without a mask
        api_test(env(), num_cycles=100)
    seed_test(env)
