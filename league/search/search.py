"""Tree search over several games at once. Each round evaluates a few leaves of each game, all of them in one batch.

A simulation follows edges from the root to an edge without a node, steps the environment there, evaluates the new node,
and adds its value to the edges of the path. The simulations of a round start with the same statistics: a node sends the
first one that arrives along its best edge, and further ones as if those before them were visits already.

A few games have trees of objects, and more of them trees in arrays, with equal results.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from time import monotonic
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from league.environments.vector.vector_env import AgentRows, VectorEnv
from league.policies.draws import Generators
from league.search.array_trees import ArrayTrees
from league.search.object_trees import ObjectTrees
from league.search.rules import Evaluate, Nodes, Rule

LEAVES = 8
"""The most leaves of a game that a round evaluates. It does not depend on the number of games, so neither do results.
With 1, each simulation sees the values of all those before it."""
FEW_GAMES = 2
"""The most games with trees of objects."""


@dataclass(frozen=True, slots=True)
class SearchResult:
    """Results of a search from k positions.

    Attributes:
        actions: The best actions, counted from 0, (k,) int64.
        logits: Logits of the improved policy, (k, actions) float32; ILLEGAL for illegal actions.
        visits: Simulations through each action, (k, actions) int64.
        values: Mean value for the agent that must act, (k,) float32.
        lines: The expected moves: the best action, then the most visited ones, then -1, (k, n) int64.
    """

    actions: NDArray[np.int64]
    logits: NDArray[np.float32]
    visits: NDArray[np.int64]
    values: NDArray[np.float32]
    lines: NDArray[np.int64]


class Trees(Protocol):
    """Trees of k games, whose nodes are copies of an environment."""

    def begin(self, rows: Sequence[AgentRows]) -> Nodes:
        """Begin with trees that have a root only, and return the statistics of the roots.

        rows: one for each root, of the agent that must act there.
        """

    def simulate(self, number: int, sizes: NDArray[np.int64]) -> None:
        """Run a round. number: of the round, from 0. sizes: simulations of each game, (k,)."""

    def roots(self) -> Nodes:
        """Return the statistics of the roots."""

    def lines(self, actions: NDArray[np.int64], moves: int) -> NDArray[np.int64]:
        """Return `SearchResult.lines`. actions: the first moves, (k,)."""


class Search:
    """Searches from up to `games` positions at once, in games without chance in which one agent acts at a time.

    The result for a position does not depend on the others.

    Attributes:
        env: The environment with the states of all nodes. The caller puts the positions into its copies `roots`.
        roots: (games,) int64.
    """

    def __init__(
        self,
        make: Callable[[int], VectorEnv],
        evaluate: Evaluate,
        rule: Rule,
        *,
        games: int,
        simulations: int,
        num_actions: int,
        leaves: int = LEAVES,
        few_games: int = FEW_GAMES,
    ) -> None:
        """make: number of copies → environment. num_actions: of each agent. leaves, few_games: see the constants."""
        self.env, self.roots = make(games * (simulations + 1)), np.arange(games) * (simulations + 1)
        self._rule, self._simulations, self._leaves = rule, simulations, leaves
        self._objects = ObjectTrees(self.env, self.roots, evaluate, rule, num_actions)
        self._few_games, self._arrays = few_games, None
        if games > few_games:
            self._arrays = ArrayTrees(self.env, self.roots, evaluate, rule, num_actions, leaves)

    def run(
        self,
        rows: Sequence[AgentRows],
        rng: Generators | None = None,
        deadline: float = math.inf,
        moves: int = 0,
    ) -> SearchResult:
        """Search from the first k of `roots`.

        Args:
            rows: One row for each, of the agent that must act there.
            rng: One generator for each of them; None for a search without noise.
            deadline: Time of `time.monotonic` after which no further round begins, except the first one. With it, the
                result depends on the speed.
            moves: The length of `lines` in the result.
        """
        games = sum(len(block.envs) for block in rows)
        trees: Trees = self._objects if self._arrays is None or games <= self._few_games else self._arrays
        sizes = self._rule.start(trees.begin(rows), self._simulations, self._leaves, rng)
        for number, size in enumerate(sizes.T):
            trees.simulate(number, size)
            if monotonic() > deadline:
                break
        roots = trees.roots()
        actions, logits = self._rule.result(roots)
        values = (roots.value + roots.total) / (1 + roots.total_visits)
        lines = trees.lines(actions, moves)
        visits = roots.visits.astype(np.int64)
        return SearchResult(actions, logits.astype(np.float32), visits, values.astype(np.float32), lines)
