"""Leduc hold'em with PettingZoo's (RLCard's) rules, small enough for an exact best response.

RLCard's game differs from that of the literature: blinds of 1 and 2 chips, assigned at random, the small one acting
first; raises of 2 chips, then of 4, at most two per round; folding is always legal; payoffs are in big blinds. A policy
observes its card, the public one, and both players' chips, but not the order of the bets. The best response remembers
everything.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from league.policies.policy import Policy
from policy_league.examples.leduc_holdem import MOST_ACTIONS, ROUNDS

CALL, RAISE, FOLD, CHECK = range(4)
RANKS, COPIES, BIG_BLIND, MAX_RAISES = 3, 2, 2, 2
HIDDEN = None
"""The public card before the second round."""

PolicyFunction = Callable[[NDArray, NDArray], NDArray]
"""Observation and mask (4,) → probabilities (4,)."""


@dataclass(frozen=True, slots=True)
class Hand:
    """The public state. Player 0 has the small blind. bets: chips of this round; chips: of all rounds."""

    chips: tuple[int, int] = (1, 2)
    bets: tuple[int, int] = (1, 2)
    turn: int = 0
    raises: int = 0
    settled: int = 0
    """Consecutive players without a raise; the round ends with two."""
    round: int = 0
    public: int | None = HIDDEN
    folded: int | None = None
    history: tuple[tuple[int, ...], tuple[int, ...]] = ((), ())
    """The actions of both rounds."""

    @property
    def awaits_card(self) -> bool:
        """Whether the public card must be dealt."""
        return self.round == 1 and self.public is HIDDEN and self.folded is None

    @property
    def is_over(self) -> bool:
        return self.folded is not None or self.round == 2

    def legal(self) -> NDArray:
        """(4,) of 0 and 1."""
        owes = self.bets[self.turn] < max(self.bets)
        return np.array([owes, self.raises < MAX_RAISES, True, not owes], dtype=np.int8)

    def after(self, action: int) -> "Hand":
        """The hand after an action of the player to act."""
        first, second = self.history
        history = ((*first, action), second) if self.round == 0 else (first, (*second, action))
        if action == FOLD:
            return replace(self, folded=self.turn, history=history)
        paid = 0 if action == CHECK else max(self.bets) - self.bets[self.turn]
        if action == RAISE:
            paid += BIG_BLIND * (1 + self.round)
        hand = replace(
            self,
            chips=_plus(self.chips, self.turn, paid),
            bets=_plus(self.bets, self.turn, paid),
            turn=1 - self.turn,
            raises=self.raises + (action == RAISE),
            settled=1 if action == RAISE else self.settled + 1,
            history=history,
        )
        if hand.settled < 2:
            return hand
        return replace(hand, bets=(0, 0), raises=0, settled=0, round=self.round + 1)

    def observation(self, rank: int) -> NDArray:
        """The observation of the player to act with the card `rank`."""
        observation = np.zeros(36, np.float32)
        observation[rank] = 1
        if self.public is not HIDDEN:
            observation[3 + self.public] = 1
        observation[6 + self.chips[self.turn]] = observation[21 + self.chips[1 - self.turn]] = 1
        return observation

    def information_state(self, rank: int) -> NDArray:
        """The observation of `examples.leduc_holdem`: that of the player to act, and the actions of both rounds."""
        actions = np.zeros((ROUNDS, MOST_ACTIONS, 4), np.float32)
        for round_, taken_actions in enumerate(self.history):
            actions[round_, range(len(taken_actions)), list(taken_actions)] = 1
        return np.concatenate([self.observation(rank), actions.ravel()])

    def payoff(self, player: int, ranks: tuple[int, int]) -> float:
        """The payoff of a finished hand. ranks: the players' cards."""
        if self.folded is not None:
            won = -1 if self.folded == player else 1
        else:
            # A pair with the public card wins, otherwise the higher card.
            strengths = [rank + RANKS * (rank == self.public) for rank in ranks]
            won = int(np.sign(strengths[player] - strengths[1 - player]))
        return won * (self.chips[1 - player] if won > 0 else self.chips[player]) / BIG_BLIND if won else 0.0


def best_response(policy_function: PolicyFunction, observe: Callable[[Hand, int], NDArray] = Hand.observation) -> float:
    """The maximum win of an opponent against a policy, per hand in big blinds; both have each blind equally often.

    observe: what the policy observes of a hand with its card.
    """
    play = cache(lambda hand, rank: policy_function(observe(hand, rank), hand.legal()))
    return float(np.mean([_dealt(play, player) for player in (0, 1)]))


def uniform(_: NDArray, mask: NDArray) -> NDArray:
    """All legal actions with equal probability."""
    return mask / mask.sum()


def greedy(policy: Policy) -> PolicyFunction:
    """A policy with greedy actions, as in matches."""

    def policy_function(observation: NDArray, mask: NDArray) -> NDArray:
        inputs = {"observation": observation[np.newaxis], "action_mask": mask[np.newaxis]}
        return np.eye(4)[int(policy.act(inputs).actions[0])]

    return policy_function


def _dealt(play: Callable[[Hand, int], NDArray], player: int) -> float:
    """The value of the best response as `player`, averaged over its cards and those of the opponent."""
    value = 0.0
    for rank in range(RANKS):
        chances = np.array([COPIES - (other == rank) for other in range(RANKS)]) / (RANKS * COPIES - 1)
        value += _value(play, Hand(), player, rank, chances) / RANKS
    return value


def _value(play: Callable[[Hand, int], NDArray], hand: Hand, player: int, rank: int, reach: NDArray) -> float:
    """The value of a hand for the best response with the card `rank`. reach (3,): the joint probability of each card of
    the opponent and of its previous actions with it.
    """
    if hand.is_over:
        ranks = [(rank, other) if player == 0 else (other, rank) for other in range(RANKS)]
        return sum(p * hand.payoff(player, pair) for p, pair in zip(reach, ranks, strict=True) if p)
    if hand.awaits_card:
        left = RANKS * COPIES - 2
        value = 0.0
        for public in range(RANKS):
            chances = np.array([COPIES - (public == rank) - (public == other) for other in range(RANKS)]) / left
            value += _value(play, replace(hand, public=public), player, rank, reach * chances.clip(min=0))
        return value
    actions = np.flatnonzero(hand.legal()).tolist()
    if hand.turn == player:
        return max(_value(play, hand.after(action), player, rank, reach) for action in actions)
    plays = np.stack([play(hand, other) for other in range(RANKS)])
    return sum(_value(play, hand.after(action), player, rank, reach * plays[:, action]) for action in actions)


def _plus(pair: tuple[int, int], place: int, amount: int) -> tuple[int, int]:
    return (pair[0] + amount, pair[1]) if place == 0 else (pair[0], pair[1] + amount)
