"""Vectorised Leduc hold'em, equal to PettingZoo's `leduc_holdem_v4`."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from league.environments.vector.leduc.deals import deal, fast_deal
from league.environments.vector.leduc.rules import Situation
from league.environments.vector.vector_env import AgentRows, UnsupportedArguments, VectorEnv
from league.spaces import ACTION_MASK, OBSERVATION

NUM_ACTIONS = 4
NONE = -1
Start = Callable[[int, tuple[int, int, int]], Situation]
"""The player with the small blind, and the cards → the first situation of a hand."""


@dataclass(frozen=True, slots=True)
class Tables:
    """All s situations that can be reached from any deal, with r rows of agents. NONE (-1) marks missing entries.

    Attributes:
        first: First situation, by player with the small blind, and ranks of player 0's, player 1's and the public card,
            (2, 3, 3, 3) int64.
        following: Next situation by situation and legal action, (s, 4) int64.
        rows: Rows in each situation, (s, 2) int64: that of the agent who must act, or the last rows of both.
        agents: (r,) int64.
        observations: (r, features) float32.
        masks: (r, 4) int8.
        rewards: (r,) float64.
        terminations: (r,) bool.
    """

    first: NDArray[np.int64]
    following: NDArray[np.int64]
    rows: NDArray[np.int64]
    agents: NDArray[np.int64]
    observations: NDArray[np.float32]
    masks: NDArray[np.int8]
    rewards: NDArray[np.float64]
    terminations: NDArray[np.bool_]


@cache
def tables(start: Start) -> Tables:
    """Enumerate all situations that can follow the first ones."""
    first = np.full((2, 3, 3, 3), NONE)
    situations: dict[Situation, int] = {}
    for small_blind, *cards in product(range(2), range(3), range(3), range(3)):
        if len(set(cards)) > 1:
            root = start(small_blind, (cards[0], cards[1], cards[2]))
            first[small_blind, *cards] = _add(root, situations)
    following = np.full((len(situations), NUM_ACTIONS), NONE)
    rows = np.full((len(situations), 2), NONE)
    agents: list[int] = []
    of_row: list[Situation] = []
    for situation, index in situations.items():
        for action in situation.legal_actions():
            following[index, action] = situations[situation.after(action)]
        reporting = (0, 1) if situation.is_over else (situation.player,)
        rows[index, : len(reporting)] = range(len(agents), len(agents) + len(reporting))
        agents += reporting
        of_row += [situation] * len(reporting)
    pairs = list(zip(of_row, agents, strict=True))
    return Tables(
        first=first,
        following=following,
        rows=rows,
        agents=np.array(agents),
        observations=np.array([situation.observation(agent) for situation, agent in pairs]),
        masks=np.array([_mask(situation) for situation in of_row]),
        rewards=np.array([situation.rewards()[agent] if situation.is_over else 0.0 for situation, agent in pairs]),
        terminations=np.array([situation.is_over for situation in of_row]),
    )


def _add(situation: Situation, found: dict[Situation, int]) -> int:
    """Number `situation` and all that can follow it. Returns its number."""
    if situation not in found:
        found[situation] = len(found)
        for action in situation.legal_actions():
            _add(situation.after(action), found)
    return found[situation]


def _mask(situation: Situation) -> NDArray[np.int8]:
    """Return the mask of legal actions, (4,)."""
    mask = np.zeros(NUM_ACTIONS, dtype=np.int8)
    mask[situation.legal_actions()] = 1
    return mask


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
