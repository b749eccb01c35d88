"""The games of the examples: their rules, their vectorised forms, and numbers of papers."""

import itertools
import warnings
from typing import Any

import numpy as np
import pyspiel
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pettingzoo.classic import leduc_holdem_v4
from pettingzoo.test import api_test, parallel_api_test, seed_test

from benchmarks.optimal_play import blotto_exploitability, crossing_optimum, two_step_values
from league.config.environment import EnvironmentConfig
from league.environments.equality import compare
from league.random import splitmix64
from league.results.equilibria import nash_averaging
from policy_league.examples import kuhn_poker, leduc_holdem
from policy_league.examples.blotto import COINS, DIVISIONS, FIELDS, PAYOFF, Blotto
from policy_league.examples.blotto_vector import BlottoVector
from policy_league.examples.kuhn_poker import BET, DEALS, PASS, KuhnPoker
from policy_league.examples.kuhn_poker_vector import KuhnPokerVector
from policy_league.examples.leduc_holdem import MOST_ACTIONS, NUM_ACTIONS, ROUNDS, STOCK_SIZE
from policy_league.examples.leduc_holdem_vector import LeducWithHistoryVector
from policy_league.examples.traffic import GREEN, RED, Crossing, lights_reward, move, starts
from policy_league.examples.two_step import (
    AGENTS,
    FIRST,
    GAME_A,
    GAME_B,
    PAYOFFS,
    parallel_env,
)
from tests.support.environments.plans import Plan, assert_equal, last_rows, plans
from tests.support.environments.rllib_two_step import multi_agent_env

KUHN = EnvironmentConfig(entry_point="policy_league.examples.kuhn_poker")
LEDUC = EnvironmentConfig(entry_point="policy_league.examples.leduc_holdem:env")
BLOTTO = EnvironmentConfig(entry_point="policy_league.examples.blotto:env")


@pytest.mark.parametrize(
    ("config", "vector"), [(KUHN, KuhnPokerVector), (LEDUC, LeducWithHistoryVector), (BLOTTO, BlottoVector)]
)
@settings(max_examples=25)
@given(plans)
def test_the_vectorised_game_equals_the_stock_game(config: EnvironmentConfig, vector: Any, plan: Plan) -> None:
    assert_equal(config, vector(plan.num_envs), plan)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("config", "vector", "episodes"), [(KUHN, KuhnPokerVector, 60_000), (LEDUC, LeducWithHistoryVector, 10_000)]
)
def test_many_steps_equal_those_of_the_stock_game(config: EnvironmentConfig, vector: Any, episodes: int) -> None:
    comparison = compare(config, vector(256), 200_000, seed=1)
    assert comparison.difference is None
    assert comparison.episodes > episodes


def test_pettingzoo_accepts_the_environments() -> None:
    parallel_api_test(Blotto(), num_cycles=10)
    for env in (kuhn_poker.env, leduc_holdem.env):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # it expects observations without a mask
            api_test(env(), num_cycles=100)
        seed_test(env)


LINES = {
    (PASS, PASS): ("showdown", 1),
    (BET, BET): ("showdown", 2),
    (PASS, BET, BET): ("showdown", 2),
    (BET, PASS): ("first wins", 1),
    (PASS, BET, PASS): ("second wins", 1),
}
"""All betting lines: who wins, and how much."""


def cards(seed: int) -> tuple[int, int]:
    """The deal of a seed, read from the observations of the stock game."""
    game = KuhnPoker()
    game.reset(seed=seed)
    first, second = (int(game.observe(agent)["observation"][2:5].argmax()) for agent in game.possible_agents)
    return first, second


SEEDS = {cards(seed): seed for seed in range(100)}
"""Deal → a seed."""


def test_each_deal_and_line_of_kuhn_poker_is_paid() -> None:
    for deal, line in itertools.product(DEALS, LINES):
        rows = last_rows(KUHN, KuhnPokerVector(1), list(line), SEEDS[deal])
        kind, stake = LINES[line]
        first_wins = kind == "first wins" or (kind == "showdown" and deal[0] > deal[1])
        of_first = stake if first_wins else -stake
        # The row of the player whose turn it would be comes first.
        next_player = len(line) % 2
        assert rows.agents.tolist() == [next_player, 1 - next_player], (deal, line)
        assert rows.rewards.tolist() == [of_first if agent == 0 else -of_first for agent in rows.agents], (deal, line)
        assert rows.terminations.all()
        for agent, observation in zip(rows.agents, rows.observations["observation"], strict=True):
            bets = observation[5:].reshape(3, 2)[: len(line)].argmax(axis=1).tolist()
            assert (observation[:2].argmax(), observation[2:5].argmax(), bets) == (agent, deal[agent], list(line))


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


CALL, RAISE, FOLD, CHECK = range(NUM_ACTIONS)


def test_observations_of_leduc_are_those_of_pettingzoo_and_the_actions_of_both_rounds() -> None:
    for seed in range(20):
        game, stock, rng = leduc_holdem.env(), leduc_holdem_v4.raw_env(), np.random.default_rng(seed)
        bets: list[list[int]] = [[], []]
        game.reset(seed=seed)
        stock.reset(seed=seed)
        while not any(game.terminations.values()):
            actual, expected = game.observe(game.agent_selection), stock.observe(stock.agent_selection)
            np.testing.assert_array_equal(actual["observation"][:STOCK_SIZE], expected["observation"])
            np.testing.assert_array_equal(actual["action_mask"], expected["action_mask"])
            history = actual["observation"][STOCK_SIZE:].reshape(ROUNDS, MOST_ACTIONS, NUM_ACTIONS)
            assert [[int(row.argmax()) for row in rows if row.any()] for rows in history] == bets
            action = int(rng.choice(np.flatnonzero(actual["action_mask"])))
            bets[int(expected["observation"][3:6].any())].append(action)
            game.step(action)
            stock.step(action)
        assert game.rewards == stock.rewards


def test_the_order_of_bets_of_leduc_is_visible() -> None:
    """Own 2 and the opponent's 4 chips: after a call and a raise, or a raise of the small blind."""
    observations = []
    for actions in ([CALL, RAISE], [RAISE]):
        game = leduc_holdem.env()
        game.reset(seed=0)
        for action in actions:
            game.step(action)
        observations.append(game.observe(game.agent_selection)["observation"])
    chips = [np.flatnonzero(observation[6:STOCK_SIZE]).tolist() for observation in observations]
    assert chips[0] == chips[1]
    assert (observations[0][STOCK_SIZE:] != observations[1][STOCK_SIZE:]).any()


def test_a_player_sees_the_back_of_the_opponents_card() -> None:
    game = leduc_holdem.env(render_mode="rgb_array")
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


def test_payoffs_equal_those_of_open_spiel() -> None:
    game = pyspiel.load_game(f"blotto(coins={COINS},fields={FIELDS})")
    assert game.num_distinct_actions() == len(DIVISIONS)
    table = pyspiel.extensive_to_matrix_game(game)
    np.testing.assert_array_equal(np.array(table.row_utilities()), PAYOFF)


def test_only_a_mixed_policy_is_not_exploitable() -> None:
    assert blotto_exploitability(nash_averaging(PAYOFF)[0]) == pytest.approx(0, abs=1e-6)
    assert blotto_exploitability(np.eye(len(PAYOFF))[0]) == pytest.approx(1)


def test_waiting_at_red_costs_and_two_cars_in_the_crossing_crash() -> None:
    state, rewards = move(((1, 3), (2, 4)), (RED, GREEN), ((1, 0), (0, 0)))
    assert state == ((0, 3), (2, 4))
    assert rewards == ((-11.0, -1.0), (-1.0, -1.0))
    _, rewards = move(((1, 3), (1, 4)), (GREEN, GREEN), ((1, 0), (1, 0)))
    assert (rewards[0][0], rewards[1][0]) == (-21.0, -21.0)


def test_a_car_does_not_drive_into_the_one_ahead() -> None:
    state, _ = move(((1, 2), (0, 0)), (RED, RED), ((0, 1), (0, 0)))
    assert state == ((1, 2), (0, 0))
    state, _ = move(((1, 2), (0, 0)), (GREEN, RED), ((1, 1), (0, 0)))
    assert state == ((0, 1), (0, 0))


def test_the_optimum_with_one_car_per_road_equals_the_manual_result() -> None:
    """Both cars start at 1, both lights are red: one light turns green (step 1), a car passes while the other light
    turns green (step 2), the other car passes (step 3). Cars: −2 and −3; lights, each: −1, −1, −½.
    """
    assert crossing_optimum(cars=1, length=1) == pytest.approx((-2 - 3 + 2 * (-1 - 1 - 0.5)) / 4)


def test_random_play_does_not_exceed_the_optimum_and_rewards_follow_the_rules() -> None:
    env, best = Crossing(cars=1, length=2), crossing_optimum(cars=1, length=2)
    returns = []
    rng = np.random.default_rng(0)
    for seed in range(300):
        env.reset(seed=seed)
        total = 0.0
        for _ in itertools.count():
            before, colours = env.distances, env.colours
            actions = {agent: int(rng.integers(2)) for agent in env.agents}
            _, rewards, terminated, truncated, _ = env.step(actions)
            assert rewards["light_0"] == lights_reward(before, colours)
            total += sum(rewards.values())
            if terminated["__all__"] or truncated["__all__"]:
                break
        returns.append(total / 4)
    assert np.mean(returns) < best
    assert len(starts(1, 2)) == 4


def test_cars_leave_and_lights_remain_until_the_end() -> None:
    env = Crossing(cars=1, length=1)
    env.reset(seed=0)
    env.step(dict.fromkeys(env.agents, 0) | {"light_0": GREEN})
    observations, _, terminated, truncated, _ = env.step(dict.fromkeys(env.agents, 1) | {"car_1_0": 0, "light_0": RED})
    assert terminated == {"car_0_0": True, "car_1_0": False, "__all__": False}
    assert not truncated["__all__"]
    assert set(env.agents) == {"car_1_0", "light_0", "light_1"}
    assert set(observations) == {"car_0_0", *env.agents}
    for agent, observation in observations.items():
        assert env.observation_spaces[agent].contains(observation)
    assert env.render().shape == (72, 72, 3)


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
    for state in states:
        np.testing.assert_array_equal(state[AGENTS[0]], state[AGENTS[1]])
    return rewards, ends, [int(state[AGENTS[0]].argmax()) for state in states]


@pytest.mark.parametrize("make", [parallel_env, multi_agent_env])
def test_the_first_agent_selects_the_game_that_determines_the_rewards(make: Any) -> None:
    for first, other, a, b in itertools.product(range(2), repeat=4):
        rewards, ends, states = play(make(), ((first, other), (a, b)))
        game = GAME_B if first else GAME_A
        assert rewards == [0.0, float(PAYOFFS[game][a, b])]
        assert ends == [False, True]
        assert states[:2] == [FIRST, game]


def test_values_equal_the_paper_and_enumeration() -> None:
    table = two_step_values(GAMMA)
    np.testing.assert_allclose(table[FIRST], [[6.93, 6.93], [7.92, 7.92]])
    np.testing.assert_array_equal(table[GAME_A], np.full((2, 2), 7))
    np.testing.assert_array_equal(table[GAME_B], [[0, 1], [1, 8]])
    pairs = list(itertools.product(range(2), repeat=2))
    for pair in pairs:
        best = max(GAMMA * play(parallel_env(), (pair, later))[0][1] for later in pairs)
        assert table[FIRST][pair] == best


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
