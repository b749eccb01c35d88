"""Rules of Leduc hold'em with two players, as RLCard implements them.

A hand has two betting rounds. After the first, a public card is revealed. At the end a pair with the public card wins,
or else the higher card.
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

CALL, RAISE, FOLD, CHECK = range(4)
SMALL_BLIND, BIG_BLIND = 1, 2
RAISES = (2, 4)
"""Chips of a raise, by round."""
MAX_RAISES = 2
"""Raises per round."""
NUM_FEATURES = 36


@dataclass(frozen=True, slots=True)
class Situation:
    """A situation in a hand.

    Attributes:
        cards: Ranks of the cards of player 0 and player 1, and of the public card: 0 (jack), 1 (queen), 2 (king).
        player: The player who acts next.
        chips: Chips that each player has paid.
        round: Betting round, 0 or 1; 2 at the showdown.
        raises: Raises in this round.
        agreed: Players who have accepted the current bets of this round. Blinds are not counted.
        winner: The player left after a fold.
    """

    cards: tuple[int, int, int]
    player: int
    chips: tuple[int, int]
    round: int = 0
    raises: int = 0
    agreed: int = 0
    winner: int | None = None

    @classmethod
    def start(cls, small_blind: int, cards: tuple[int, int, int]) -> Self:
        """Return the first situation of a hand. The player with the small blind acts first."""
        chips = (SMALL_BLIND, BIG_BLIND) if small_blind == 0 else (BIG_BLIND, SMALL_BLIND)
        return cls(cards, small_blind, chips)

    @property
    def is_over(self) -> bool:
        return self.winner is not None or self.round == len(RAISES)

    def legal_actions(self) -> list[int]:
        """Return the actions of the player who acts next; none if the hand is over."""
        if self.is_over:
            return []
        accept = CHECK if self.chips[0] == self.chips[1] else CALL
        return [accept, FOLD] if self.raises == MAX_RAISES else [accept, FOLD, RAISE]

    def after(self, action: int) -> Self:
        """Return the situation after a legal action."""
        other = 1 - self.player
        if action == FOLD:
            return replace(self, player=other, winner=other)
        if action == RAISE:
            chips = self._paid(self.chips[other] + RAISES[self.round])
            return replace(self, player=other, chips=chips, raises=self.raises + 1, agreed=1)
        agreed = replace(self, player=other, chips=self._paid(self.chips[other]), agreed=self.agreed + 1)
        return agreed if agreed.agreed < 2 else replace(agreed, round=self.round + 1, raises=0, agreed=0)

    def rewards(self) -> tuple[float, float]:
        """Return the rewards at the end of a hand: chips won in big blinds."""
        winners = self._winners()
        share = sum(self.chips) / len(winners)
        first, second = ((share if player in winners else 0.0) - self.chips[player] for player in (0, 1))
        return first / BIG_BLIND, second / BIG_BLIND

    def observation(self, player: int) -> NDArray[np.float32]:
        """Return RLCard's features, (36,): own card, public card, own chips and the other's chips, all one-hot."""
        features = np.zeros(NUM_FEATURES, dtype=np.float32)
        features[self.cards[player]] = 1
        if self.round > 0:
            features[3 + self.cards[2]] = 1
        features[6 + self.chips[player]] = 1
        features[21 + self.chips[1 - player]] = 1
        return features

    def _paid(self, chips: int) -> tuple[int, int]:
        """Return the chips of both players after the player who acts has paid `chips` in total."""
        return (chips, self.chips[1]) if self.player == 0 else (self.chips[0], chips)

    def _winners(self) -> tuple[int, ...]:
        if self.winner is not None:
            return (self.winner,)
        strengths = [(card == self.cards[2], card) for card in self.cards[:2]]
        return tuple(player for player in (0, 1) if strengths[player] == max(strengths))
