"""Vectorised Leduc hold'em, equal to PettingZoo's `leduc_holdem_v4`."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from league.environments.vector.leduc.deals import deal, fast_deal
from league.environments.vector.leduc.rules import Situation
from league.environments.vector.leduc.tables import tables
from league.environments.vector.vector_env import AgentRows, UnsupportedArguments, VectorEnv
from league.spaces import ACTION_MASK, OBSERVATION


class LeducHoldem(VectorEnv):
    """Leduc hold'em with two players. A copy's state is the index of its situation in a table of all situations."""

    possible_agents = ("player_0", "player_1")
    situation: type[Situation] = Situation
    """The situations that the table lists."""

    def __init__(self, num_envs: int, **arguments: Any) -> None:
        if arguments:
            raise UnsupportedArguments(
                f"leduc_holdem_v4 is vectorised without arguments, not with {', '.join(sorted(arguments))}"
            )
        self.num_envs = num_envs
        self._tables = tables(self.situation.start)
        self._situations = np.zeros(num_envs, dtype=np.int64)
        self._deal = deal

    def use_fast_seeds(self) -> None:
        self._deal = fast_deal

    def reset(self, env_ids: NDArray[np.int64], seeds: NDArray[np.int64]) -> Sequence[AgentRows]:
        return self._rows(env_ids, self._tables.first[self._deal(seeds)])

    def step(self, env_ids: NDArray[np.int64], actions: NDArray[Any]) -> Sequence[AgentRows]:
        return self._rows(env_ids, self._tables.following[self._situations[env_ids], actions])

    def _rows(self, env_ids: NDArray[np.int64], situations: NDArray[np.int64]) -> Sequence[AgentRows]:
        """Report the situations that these copies have reached."""
        self._situations[env_ids] = situations
        tables = self._tables
        # `take` is several times as fast as indices in brackets.
        rows = tables.rows.take(situations, axis=0)
        present = np.flatnonzero(rows >= 0)
        copies, rows = present // rows.shape[1], rows.ravel().take(present)
        return (
            AgentRows(
                envs=env_ids.take(copies),
                agents=tables.agents.take(rows),
                observations={
                    OBSERVATION: tables.observations.take(rows, axis=0),
                    ACTION_MASK: tables.masks.take(rows, axis=0),
                },
                rewards=tables.rewards.take(rows),
                terminations=tables.terminations.take(rows),
                truncations=np.zeros(len(rows), dtype=bool),
            ),
        )
