"""Deals of Leduc hold'em, for many seeds at once."""

import random
from hashlib import sha512
from itertools import permutations, product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from league.random import splitmix64

NUM_OUTPUTS = 24
"""Outputs computed at first. More are computed if the draws of a generator need more."""


class Generators:
    """The generators of RLCard's games with m seeds. The draws of each equal those of `numpy.random.RandomState`."""

    def __init__(self, seeds: NDArray[np.int64]) -> None:
        self._seeds = seeds
        self._outputs = outputs(seeds, NUM_OUTPUTS)
        self._rows = np.arange(len(seeds))
        self._used = np.zeros(len(seeds), dtype=np.int64)

    def integers(self, highest: int) -> NDArray[np.int64]:
        """Draw an integer from 0 to `highest` (at least 1) from each generator, (m,).

        RandomState takes the lowest bits of its outputs, and skips outputs that are too high.
        """
        values = self._outputs & np.uint32(2 ** highest.bit_length() - 1)
        accepted = values <= highest
        accepted &= np.arange(values.shape[1]) >= self._used[:, np.newaxis]
        first = accepted.argmax(axis=1)
        if not accepted[self._rows, first].all():
            self._outputs = outputs(self._seeds, 2 * values.shape[1])
            return self.integers(highest)
        self._used = first + 1
        return values[self._rows, first].astype(np.int64)


def outputs(seeds: NDArray[np.int64], count: int) -> NDArray[np.uint32]:
    """Return the first `count` outputs of RLCard's generators with m seeds, (m, count).

    RLCard initialises a RandomState with the first 64 bits of the seed's SHA-512 hash. Python's `random.Random` is the
    same generator (MT19937) and has the same initialisation, but takes half the time.
    """
    generator = random.Random(0)
    buffer = bytearray()
    for seed in seeds.tolist():
        generator.seed(int.from_bytes(sha512(b"%d" % seed).digest()[:8], "little"))
        buffer += generator.getrandbits(32 * count).to_bytes(4 * count, "little")
    return np.frombuffer(buffer, dtype="<u4").reshape(len(seeds), count)


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
