"""Deals of Leduc hold'em, for many seeds at once."""

from itertools import permutations, product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from league.environments.vector.leduc.generators import Generators
from league.random import splitmix64

RANKS = np.array([0, 0, 1, 1, 2, 2])
"""Ranks of the cards in RLCard's unshuffled deck: two jacks, two queens, two kings."""


class Deals(NamedTuple):
    """Random results of m hands. Ranks of cards are 0 (jack), 1 (queen) and 2 (king).

    Attributes:
        small_blinds: The player who pays the small blind and acts first, (m,) int64.
        first: Rank of player 0's card, (m,) int64.
        second: Rank of player 1's card, (m,) int64.
        public: Rank of the public card, (m,) int64.
    """

    small_blinds: NDArray[np.int64]
    first: NDArray[np.int64]
    second: NDArray[np.int64]
    public: NDArray[np.int64]


def deal(seeds: NDArray[np.int64]) -> Deals:
    """Deal the hands with m seeds, in RLCard's order of draws."""
    generators = Generators(seeds)
    rows = np.arange(len(seeds))
    decks = np.tile(RANKS, (len(seeds), 1))
    for last in range(len(RANKS) - 1, 0, -1):
        drawn = generators.integers(last)
        decks[rows, drawn], decks[:, last] = decks[:, last], decks[rows, drawn]
    # Cards are dealt from the end of the deck.
    return Deals(generators.integers(1), decks[:, 5], decks[:, 4], decks[:, 3])


EQUALLY_PROBABLE = np.array([(small_blind, *cards) for small_blind, cards in product((0, 1), permutations(RANKS, 3))]).T
"""The small blind with each choice of three cards from the deck, in order: the rows of Deals, (4, 240)."""


def fast_deal(seeds: NDArray[np.int64]) -> Deals:
    """Deal hands with the same distribution as RLCard's, in a hundredth of the time."""
    return Deals(*EQUALLY_PROBABLE[:, splitmix64.integers(seeds, EQUALLY_PROBABLE.shape[1])])
