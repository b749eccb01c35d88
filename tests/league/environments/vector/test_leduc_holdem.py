from collections.abc import Iterator
from dataclasses import asdict
from itertools import product

import numpy as np
import pytest

from league.config.environment import EnvironmentConfig
from league.environments.vector.equality import DifferentialTest
from league.environments.vector.leduc.deals import deal, fast_deal
from league.environments.vector.leduc.rules import CALL, CHECK, FOLD, RAISE
from league.environments.vector.leduc_holdem import LeducHoldem
from league.environments.vector.vector_env import AgentRows
from league.spaces import ACTION_MASK, OBSERVATION

LEDUC = EnvironmentConfig(entry_point="pettingzoo.classic.leduc_holdem_v4")


JACK, QUEEN, KING = range(3)


def play(seed: int, actions: list[int]) -> AgentRows:
    """Play legal actions in one copy. Returns the last reports."""
    env, copy = LeducHoldem(1), np.array([0])
    (rows,) = env.reset(copy, np.array([seed]))
    for action in actions:
        assert rows.observations[ACTION_MASK][0, action], f"action {action} is illegal"
        (rows,) = env.step(copy, np.array([action]))
    return rows


def seed_of(small_blind: int, first: int, second: int, public: int) -> int:
    """Return a seed with this deal."""
    found = np.transpose(deal(np.arange(2000))) == (small_blind, first, second, public)
    return int(np.flatnonzero(found.all(axis=1))[0])


def test_all_lines_with_all_deals() -> None:
    cards = [cards for cards in product(range(3), repeat=3) if len(set(cards)) > 1]
    seeds = np.array([seed_of(small_blind, *dealt) for small_blind in (0, 1) for dealt in cards])
    copies = np.arange(len(seeds))
    test = DifferentialTest(LEDUC, LeducHoldem(len(seeds)))
    every = list(lines(0))
    assert len(every) == 6 + 5 * 11, "6 folds in the first round, or one of 5 ways to the second with its 11"
    for actions in every:
        test.reset(copies, seeds)
        for action in actions:
            test.step(copies, np.full(len(seeds), action))
        assert test.is_over.all()
    test.finish()


def test_a_hand_with_a_fast_seed_is_the_stock_hand_with_its_deal() -> None:
    copies, seeds = np.arange(100), 2**31 - 1 - np.arange(100)
    fast, stock = LeducHoldem(100), LeducHoldem(100)
    fast.use_fast_seeds()
    reports = [
        fast.reset(copies, seeds),
        stock.reset(copies, np.array([seed_of(*hand) for hand in zip(*fast_deal(seeds), strict=True)])),
    ]
    for actions in MOST_CHIPS:
        for (mine,), (theirs,) in [reports]:
            np.testing.assert_equal(asdict(mine), asdict(theirs))
        reports = [env.step(copies, np.full(100, actions)) for env in (fast, stock)]
    np.testing.assert_array_equal(reports[0][0].rewards, reports[1][0].rewards)


MOST_CHIPS = [RAISE, RAISE, CALL, RAISE, RAISE, CALL]


def lines(seed: int, actions: tuple[int, ...] = ()) -> Iterator[tuple[int, ...]]:
    """All sequences of actions in a hand that begin with `actions`."""
    legal = np.flatnonzero(play(seed, list(actions)).observations[ACTION_MASK][0])
    for action in legal.tolist():
        yield from lines(seed, (*actions, action))
    if not len(legal):
        yield actions


def test_hands(subtests: pytest.Subtests) -> None:
    """Actions, cards (of player 0, of player 1, public) and the reward of player 0."""
    for actions, cards, reward in (
        ([FOLD], (JACK, KING, KING), -0.5),
        ([CALL, FOLD], (JACK, KING, KING), 1),
        ([CALL, CHECK, RAISE, FOLD], (JACK, KING, KING), 1),
        ([RAISE, FOLD], (JACK, KING, KING), 1),
        (MOST_CHIPS, (QUEEN, JACK, KING), 7),
        (MOST_CHIPS, (QUEEN, KING, JACK), -7),
        (MOST_CHIPS, (JACK, KING, JACK), 7),
        (MOST_CHIPS, (KING, JACK, JACK), -7),
        (MOST_CHIPS, (QUEEN, QUEEN, KING), 0),
    ):
        with subtests.test(actions=actions, cards=cards):
            rows = play(seed_of(0, *cards), actions)
            assert rows.rewards.tolist() == [reward, -reward]
            assert not np.signbit(rows.rewards[rows.rewards == 0]).any()
            assert rows.agents.tolist() == [0, 1]
            assert not rows.observations[ACTION_MASK].any()


def test_what_players_see_and_may_do() -> None:
    for small_blind, card in ((0, KING), (1, QUEEN)):
        rows = play(seed_of(small_blind, KING, QUEEN, JACK), [])
        assert rows.agents.tolist() == [small_blind], "the player with the small blind starts"
        assert np.flatnonzero(rows.observations[OBSERVATION][0]).tolist() == [card, 6 + 1, 21 + 2]
    seed = seed_of(0, KING, QUEEN, JACK)
    for actions in (MOST_CHIPS[:2], MOST_CHIPS[:5]):
        legal = play(seed, actions).observations[ACTION_MASK][0]
        assert np.flatnonzero(legal).tolist() == [CALL, FOLD], "each round allows two raises"
    for actions, public in (([CALL], []), ([RAISE, FOLD], []), ([CALL, CHECK], [JACK]), ([CALL, CHECK, FOLD], [JACK])):
        for features in play(seed, actions).observations[OBSERVATION]:
            assert np.flatnonzero(features[3:6]).tolist() == public
