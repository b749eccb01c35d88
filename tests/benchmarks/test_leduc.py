"""The game tree equals PettingZoo's game, and its best responses equal known values."""

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.training.leduc import CALL, CHECK, FOLD, RAISE, RANKS, Hand, best_response, uniform
from policy_league.examples.leduc_holdem import STOCK_SIZE
from policy_league.examples.leduc_holdem import env as with_history


def test_hands_equal_those_of_the_environment() -> None:
    env = with_history()
    for seed in range(200):
        env.reset(seed=seed)
        rng, hand = np.random.default_rng(seed), Hand()
        roles = {env.agent_selection: 0}
        ranks: dict[int, int] = {}
        while True:
            agent = env.agent_selection
            player = roles.setdefault(agent, 1)
            seen, *_ = env.last()
            rank = ranks.setdefault(player, int(seen["observation"][:RANKS].argmax()))
            if hand.awaits_card:
                hand = Hand(
                    **{f: getattr(hand, f) for f in Hand.__slots__} | {"public": int(seen["observation"][3:6].argmax())}
                )
            assert hand.turn == player
            np.testing.assert_array_equal(hand.observation(rank), seen["observation"][:STOCK_SIZE])
            np.testing.assert_array_equal(hand.information_state(rank), seen["observation"])
            np.testing.assert_array_equal(hand.legal(), seen["action_mask"])
            action = int(rng.choice(np.flatnonzero(seen["action_mask"])))
            hand = hand.after(action)
            env.step(action)
            if hand.is_over:
                break
        for agent, player in roles.items():
            held = (ranks.get(0, 0), ranks.get(1, 0))
            assert env.rewards[agent] == hand.payoff(player, held)


def always(*actions: int) -> object:
    def act(_: NDArray, mask: NDArray) -> NDArray:
        return np.eye(4)[next(action for action in actions if mask[action])]

    return act


def test_known_best_responses() -> None:
    """A policy that always folds loses the small blind or the big blind: (0.5 + 1) / 2."""
    assert best_response(uniform) == pytest.approx(1.4716, abs=1e-4)
    assert best_response(always(FOLD)) == pytest.approx(0.75)
    assert best_response(always(CALL, CHECK)) > 0
    assert best_response(always(RAISE, CALL, CHECK)) > best_response(always(CALL, CHECK))
