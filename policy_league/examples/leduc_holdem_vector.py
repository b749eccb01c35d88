"""Vectorised Leduc hold'em with information states: many hands at once, equal to leduc_holdem.py."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from league.environments.vector.leduc.rules import Situation
from league.environments.vector.leduc_holdem import LeducHoldem
from policy_league.examples.leduc_holdem import MOST_ACTIONS, NUM_ACTIONS, ROUNDS


@dataclass(frozen=True)
class SituationWithHistory(Situation):
    """A situation, and the actions of both rounds that led to it."""

    history: tuple[tuple[int, ...], tuple[int, ...]] = ((), ())

    def after(self, action: int) -> Self:
        """See Situation."""
        first, second = self.history
        history = ((*first, action), second) if self.round == 0 else (first, (*second, action))
        return replace(super().after(action), history=history)

    def observation(self, player: int) -> NDArray[np.float32]:
        """Return the features of Situation and of the actions, (68,)."""
        actions = np.zeros((ROUNDS, MOST_ACTIONS, NUM_ACTIONS), np.float32)
        for features, of_round in zip(actions, self.history, strict=True):
            features[np.arange(len(of_round)), list(of_round)] = 1
        return np.concatenate([super().observation(player), actions.ravel()])


class LeducWithHistoryVector(LeducHoldem):
    """Copies of Leduc hold'em that also report the actions of the hand."""

    situation = SituationWithHistory
