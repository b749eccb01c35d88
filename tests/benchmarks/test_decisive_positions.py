"""Positions in which not every move keeps the outcome."""

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.decisive_positions import EARLIEST, DecisivePositions, decisive_positions
from benchmarks.training.leduc import CALL, CHECK, FOLD, RAISE, RANKS, Hand, best_response, uniform
from league.config.league import LeagueConfig
from league.environments.building import interface
from league.policies.loading import contestant
from league.policies.policy import Policy
from policy_league.examples.leduc_holdem import STOCK_SIZE
from policy_league.examples.leduc_holdem import env as with_history


def script(name: str) -> Policy:
    config = LeagueConfig.from_mapping(
        {"league": "connect_four", "environment": {"entry_point": "pettingzoo.classic.connect_four_v3"}}
    )
    return next(iter(contestant(f"script:{name}", None, interface(config)).values()))[1]


@pytest.fixture(scope="module")
def positions() -> DecisivePositions:
    return decisive_positions(12, script("one_ply"))


def test_some_moves_keep_the_outcome_and_some_do_not(positions: DecisivePositions) -> None:
    legal = positions.masks != 0
    assert (positions.boards.sum(axis=(1, 2, 3)) >= EARLIEST).all()
    assert (positions.keeping <= legal).all()
    assert positions.keeping.any(axis=1).all()
    assert (positions.keeping.sum(axis=1) < legal.sum(axis=1)).all()


def test_they_are_the_same_in_each_run(positions: DecisivePositions) -> None:
    again = decisive_positions(12, script("one_ply"))
    np.testing.assert_array_equal(again.boards, positions.boards)
    np.testing.assert_array_equal(again.keeping, positions.keeping)


def test_perfect_play_keeps_each_outcome(positions: DecisivePositions) -> None:
    assert positions.kept(script("solver")).all()
    assert not positions.kept(script("random")).all()


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
            observation, *_ = env.last()
            rank = ranks.setdefault(player, int(observation["observation"][:RANKS].argmax()))
            if hand.awaits_card:
                hand = Hand(
                    **{f: getattr(hand, f) for f in Hand.__slots__}
                    | {"public": int(observation["observation"][3:6].argmax())}
                )
            assert hand.turn == player
            np.testing.assert_array_equal(hand.observation(rank), observation["observation"][:STOCK_SIZE])
            np.testing.assert_array_equal(hand.information_state(rank), observation["observation"])
            np.testing.assert_array_equal(hand.legal(), observation["action_mask"])
            action = int(rng.choice(np.flatnonzero(observation["action_mask"])))
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
