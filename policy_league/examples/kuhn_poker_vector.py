"""Vectorised Kuhn poker: many hands at once, equal to kuhn_poker.py."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from league.environments.vector.alternation import TurnRows, rows_after_move
from league.environments.vector.vector_env import AgentRows, VectorEnv
from league.random import pcg64, splitmix64
from policy_league.examples.kuhn_poker import AGENTS, BET, DEALS, FIRST_BET, FIRST_CARD, OBSERVATION_SIZE, PASS

CARDS = np.array(DEALS)
NO_ACTION = -1


def stock_deals(seeds: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the deals of the stock environment, as indices of DEALS, (m,)."""
    # The first number of `np.random.default_rng(seed).random()`, for all seeds.
    random = pcg64.uniform(pcg64.outputs(seeds, 1)[0], 0, 1)
    return (len(DEALS) * random).astype(np.int64)


def fast_deals(seeds: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return deals with the same distribution, in a tenth of the time."""
    return splitmix64.integers(seeds, len(DEALS))


class KuhnPokerVector(VectorEnv):
    """Copies of Kuhn poker. Each attribute is an array with one row per copy."""

    possible_agents = AGENTS

    def __init__(self, num_envs: int) -> None:
        self.num_envs = num_envs
        self._cards = np.zeros((num_envs, 2), dtype=np.int64)
        self._moves = np.zeros(num_envs, dtype=np.int64)
        self._last_action = np.zeros(num_envs, dtype=np.int64)
        self._observations = np.zeros((num_envs, 2, OBSERVATION_SIZE), dtype=np.int8)
        self._deals = stock_deals

    def use_fast_seeds(self) -> None:
        self._deals = fast_deals

    def reset(self, env_ids: NDArray[np.int64], seeds: NDArray[np.int64]) -> Sequence[AgentRows]:
        cards = CARDS[self._deals(seeds)]
        self._cards[env_ids] = cards
        self._moves[env_ids] = 0
        self._last_action[env_ids] = NO_ACTION
        self._observations[env_ids] = 0
        for player in range(2):
            self._observations[env_ids, player, player] = 1
            self._observations[env_ids, player, FIRST_CARD + cards[:, player]] = 1
        rows = len(env_ids)
        return self._reports(
            TurnRows(env_ids, np.zeros(rows, dtype=np.int64), np.zeros(rows), np.zeros(rows, dtype=bool))
        )

    def step(self, env_ids: NDArray[np.int64], actions: NDArray[np.int64]) -> Sequence[AgentRows]:
        moves, last_action, cards = self._moves[env_ids], self._last_action[env_ids], self._cards[env_ids]
        self._moves[env_ids] = moves + 1
        self._last_action[env_ids] = actions
        self._observations[env_ids, :, FIRST_BET + 2 * moves + actions] = 1
        player = moves % 2
        folded = (last_action == BET) & (actions == PASS)
        showdown = last_action == actions
        is_higher = (cards[:, 0] > cards[:, 1]) == (player == 0)
        stake = 1 + actions
        gains = np.where(folded, -1, np.where(is_higher, stake, -stake))
        return self._reports(rows_after_move(env_ids, player, folded | showdown, gains))

    def _reports(self, rows: TurnRows) -> tuple[AgentRows]:
        must_act = ~rows.terminations
        observations = {
            "observation": self._observations[rows.envs, rows.agents],
            "action_mask": np.repeat(must_act[:, np.newaxis], 2, axis=1).astype(np.int8),
        }
        return (AgentRows(rows.envs, rows.agents, observations, *rows[2:], np.zeros(len(rows.envs), dtype=bool)),)
