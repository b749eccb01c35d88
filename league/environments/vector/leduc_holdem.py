"""Vectorised Leduc hold'em, equal to PettingZoo's `leduc_holdem_v4`."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from league.environments.vector.leduc.deals import deal, fast_deal
from league.environments.vector.leduc.tables import tables
from league.environments.vector.vector_env import AgentRows, UnsupportedArguments, VectorEnv
from league.spaces import ACTION_MASK, OBSERVATION


class LeducHoldem(VectorEnv):
    """Leduc hold'em with two players. A copy's state is the index of its situation in a table of all situations."""

    possible_agents = ("player_0", "player_1")

    def __init__(self, num_envs: int, **arguments: Any) -> None:
        if arguments:
            raise UnsupportedArguments(
                f"leduc_holdem_v4 is vectorised without arguments, not with {', '.join(sorted(arguments))}"
            )
        self.num_envs = num_envs
        self._tables = tables()
        self._situations = np.zeros(num_envs, dtype=np.int64)
        self._deal = deal

    def use_fast_seeds(self) -> None:
        self._deal = fast_deal

    def reset(self, env_ids: NDArray[np.int64], seeds: NDArray[np.int64]) -> Sequence[AgentRows]:
        self._situations[env_ids] = self._tables.first[self._deal(seeds)]
        return self._rows(env_ids)

    def step(self, env_ids: NDArray[np.int64], actions: NDArray[Any]) -> Sequence[AgentRows]:
        self._situations[env_ids] = self._tables.following[self._situations[env_ids], actions]
        return self._rows(env_ids)

    def _rows(self, env_ids: NDArray[np.int64]) -> Sequence[AgentRows]:
        tables = self._tables
        rows = tables.rows[self._situations[env_ids]]
        has_row = rows >= 0
        copies, _ = np.nonzero(has_row)
        rows = rows[has_row]
        return (
            AgentRows(
                envs=env_ids[copies],
                agents=tables.agents[rows],
                observations={OBSERVATION: tables.observations[rows], ACTION_MASK: tables.masks[rows]},
                rewards=tables.rewards[rows],
                terminations=tables.terminations[rows],
                truncations=np.zeros(len(rows), dtype=bool),
            ),
        )
