from collections import Counter
from collections.abc import Callable
from math import factorial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from rlcard.games.leducholdem import Game
from rlcard.utils import seeding

from league.environments.vector.leduc import deals
from league.environments.vector.leduc.deals import EQUALLY_PROBABLE, Deals, Generators, deal, fast_deal
from league.random import splitmix64

RANKS = "JQK"


def rlcards_deal(seed: int) -> tuple[int, ...]:
    """Small blind and ranks of both players' cards and of the public card."""
    game = Game()
    game.np_random, _ = seeding.np_random(seed)
    _, small_blind = game.init_game()
    cards = [*(player.hand for player in game.players), game.dealer.deal_card()]
    return small_blind, *(RANKS.index(card.rank) for card in cards)


def test_deals_equal_rlcards() -> None:
    drawn = np.random.default_rng(0).integers(2**31, size=500)
    seeds = np.concatenate([np.arange(200), drawn, 2**31 - 1 - np.arange(10)])
    assert np.array_equal(np.transpose(deal(seeds)), [rlcards_deal(int(seed)) for seed in seeds])


class AllDraws:
    """Generators whose draws are the digits of their seeds: consecutive seeds have all combinations, once each."""

    def __init__(self, seeds: NDArray[np.int64]) -> None:
        self._digits = seeds

    def integers(self, highest: int) -> NDArray[np.int64]:
        self._digits, digit = np.divmod(self._digits, highest + 1)
        return digit


def test_fast_deals_have_exactly_the_distribution_of_the_stock_deals(monkeypatch: pytest.MonkeyPatch) -> None:
    """Both are enumerated: all shuffles of the deck with each small blind, and all outcomes of the fast generator."""
    monkeypatch.setattr(deals, "Generators", AllDraws)
    monkeypatch.setattr(splitmix64, "outputs", lambda _, numbers: numbers.astype(np.uint64))
    shuffles, outcomes = factorial(6) * 2, EQUALLY_PROBABLE.shape[1]
    stock, fast = counts(deal(np.arange(shuffles))), counts(fast_deal(np.arange(outcomes)))
    assert len(fast) == 2 * (3**3 - 3), "three cards of one rank are impossible"
    assert stock == {hand: count * shuffles // outcomes for hand, count in fast.items()}


SEEDS = st.lists(st.integers(0, 2**31 - 1), min_size=1, max_size=5)


@pytest.mark.parametrize("deal_cards", [deal, fast_deal])
def test_a_deal_depends_on_its_own_seed_only(deal_cards: Callable[[NDArray[np.int64]], Deals]) -> None:
    seeds = np.array([5, 0, 2**31 - 1, *range(90)])
    together = np.transpose(deal_cards(seeds)).tolist()
    assert together == [np.transpose(deal_cards(np.array([seed]))).tolist()[0] for seed in seeds]


def counts(dealt: Deals) -> Counter[tuple[int, ...]]:
    return Counter(tuple(hand) for hand in np.transpose(dealt).tolist())


@given(SEEDS | st.just([]), st.lists(st.integers(1, 1000), max_size=20), st.sampled_from([1, 3, 7, deals.NUM_OUTPUTS]))
def test_draws_equal_those_of_rlcards_generators(seeds: list[int], highest: list[int], num_outputs: int) -> None:
    """However many outputs are computed at first."""
    states = [seeding.np_random(seed)[0] for seed in seeds]
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(deals, "NUM_OUTPUTS", num_outputs)
        drawing = Generators(np.array(seeds, np.int64))
        for most in highest:
            assert drawing.integers(most).tolist() == [state.randint(0, most + 1) for state in states]
