import numpy as np
from rlcard.games.leducholdem import Game
from rlcard.utils import seeding

from league.environments.vector.leduc.deals import deal

RANKS = "JQK"


def rlcards_deal(seed: int) -> tuple[int, ...]:
    """Small blind and ranks of both players' cards and of the public card."""
    game = Game()
    game.np_random, _ = seeding.np_random(seed)
    _, small_blind = game.init_game()
    cards = [*(player.hand for player in game.players), game.dealer.deal_card()]
    return small_blind, *(RANKS.index(card.rank) for card in cards)


def test_deals_equal_rlcards() -> None:
    drawn = np.random.default_rng(0).integers(2**31, size=4000)
    seeds = np.concatenate([np.arange(1000), drawn, 2**31 - 1 - np.arange(10)])
    assert np.array_equal(np.transpose(deal(seeds)), [rlcards_deal(int(seed)) for seed in seeds])


def test_a_deal_depends_on_its_own_seed_only() -> None:
    seeds = np.arange(100)
    together = np.transpose(deal(seeds))
    assert np.array_equal(together, np.concatenate([np.transpose(deal(seeds[i : i + 1])) for i in seeds]))
    assert np.array_equal(together[::-1], np.transpose(deal(seeds[::-1])))
