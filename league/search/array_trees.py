"""Trees of many games in arrays.

Node i of game g is the copy g · (simulations + 1) + i of a vectorised environment, which holds its state. Node 0 is the
root. All statistics are arrays over these copies.

Which edge the first, the second, … simulation of a round that arrives in a node takes depends on the node's own
statistics only. It is computed when these have changed, for the nodes of all paths at once.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from league.environments.vector.vector_env import AgentRows, VectorEnv
from league.search.rules import ILLEGAL, SCALE, Evaluate, Nodes, Rule
from league.spaces import ACTION_MASK

LEAST = -(2**62)
"""What an illegal action's score as an integer is less."""


class ArrayTrees:
    """See `league.search.search.Trees`."""

    def __init__(
        self,
        env: VectorEnv,
        roots: NDArray[np.int64],
        evaluate: Evaluate,
        rule: Rule,
        num_actions: int,
        leaves: int,
    ) -> None:
        """See ObjectTrees. leaves: the most simulations of a game in a round."""
        copies = env.num_envs
        self._env, self._copies, self._evaluate, self._rule = env, roots, evaluate, rule
        self._leaves = leaves
        self._agents, self._actions = len(env.possible_agents), num_actions
        self._logits, self._visits, self._sums = np.zeros((3, copies, num_actions))
        self._value = np.zeros(copies)
        self._children = np.zeros((copies, num_actions), dtype=np.int64)
        """0 for edges without a node: 0 is a root, which is nobody's child."""
        self._edges, self._ranks, self._next = np.zeros((3, copies, leaves), dtype=np.int64)
        """For the first, second, … simulation of a round that arrives in a node: the edge that it takes, how many take
        this edge before it, and the node at its end."""
        self._places = np.arange(leaves * num_actions)[::-1].reshape(leaves, num_actions)
        self._player, self._order = np.zeros((2, copies), dtype=np.int64)
        """The agent that acts, and a node's last position in a list of nodes with repetitions."""
        self._goes_on = np.zeros(copies, dtype=bool)
        """Whether paths go on from a node: not if its game is over. False for 0, which stands for no node."""
        self._rewards, self._returns = np.zeros((2, copies, self._agents))
        """Rewards of each agent on the path from the root to the node, and these with the evaluation of the node."""

    def begin(self, rows: Sequence[AgentRows]) -> Nodes:
        """See Trees."""
        self._roots = self._copies[: sum(len(block.envs) for block in rows)]
        used = slice(0, self._env.num_envs // len(self._copies) * len(self._roots))
        for array in (self._children, self._visits, self._sums):
            array[used] = 0
        self._rewards[self._roots] = 0
        self._add(self._roots, rows)
        self._goes_on[0] = False
        self._unused, self._changed = self._roots + 1, self._roots
        self._nodes = self._statistics(self._roots)
        return self._nodes

    def simulate(self, number: int, sizes: NDArray[np.int64]) -> None:
        """See Trees."""
        self._select(self._changed, self._rule.scores(self._nodes, len(self._roots), number, self._leaves))
        self._changed = np.concatenate([self._roots, self._simulate(sizes)])
        self._nodes = self._statistics(self._changed)

    def roots(self) -> Nodes:
        """See Trees."""
        return Nodes(*(array[: len(self._roots)] for array in self._nodes))

    def lines(self, actions: NDArray[np.int64], moves: int) -> NDArray[np.int64]:
        """See Trees."""
        lines = np.full((len(actions), moves), -1)
        nodes, games = self._roots, np.arange(len(actions))
        for move in range(moves):
            lines[games, move] = actions
            children = self._children.take(nodes * self._actions + actions)
            (inside,) = (self._goes_on.take(children) & self._visits.take(children, axis=0).any(axis=1)).nonzero()
            nodes, games = children.take(inside), games.take(inside)
            actions = self._visits.take(nodes, axis=0).argmax(axis=1)
        return lines

    def _simulate(self, sizes: NDArray[np.int64]) -> NDArray[np.int64]:
        """Run the simulations of a round, and return the nodes below the roots whose statistics are new.

        sizes: simulations of each game, (games,).
        """
        ranks = np.arange(sizes.sum()) - (sizes.cumsum() - sizes).repeat(sizes)
        edges, paths, last, is_first = self._descend(self._roots.repeat(sizes), ranks)
        (added,) = ((self._children.take(last) == 0) & is_first).nonzero()
        grown = (self._unused.repeat(sizes) + ranks).take(added)
        self._unused = self._unused + sizes
        if len(added):
            self._grow(last.take(added), grown)
        leaves = self._children.take(last)
        nodes = edges // self._actions
        values = self._returns.take(leaves.take(paths) * self._agents + self._player.take(nodes))
        np.add.at(self._visits.reshape(-1), edges, 1.0)
        np.add.at(self._sums.reshape(-1), edges, values)
        below, order = nodes[len(ranks) :], np.arange(len(nodes) - len(ranks))
        self._order[below] = order
        return np.concatenate([below[self._order.take(below) == order], grown])

    def _descend(
        self, nodes: NDArray[np.int64], ranks: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
        """Follow the paths of a round from their roots.

        Args:
            nodes, ranks: The root of each path, and how many paths have it before, (k,).

        Returns:
            The edges of all paths, level by level; the path of each of them; the last edge of each path, and whether
            no path before it ends with the same one, (k,).
        """
        paths = np.arange(len(nodes))
        last, last_ranks = np.empty_like(nodes), np.empty_like(nodes)
        edges_by_level, paths_by_level = [], []
        while len(paths):
            place = nodes * self._leaves + ranks
            edges, ranks, nodes = self._edges.take(place), self._ranks.take(place), self._next.take(place)
            edges_by_level.append(edges)
            paths_by_level.append(paths)
            last[paths], last_ranks[paths] = edges, ranks
            (inside,) = self._goes_on.take(nodes).nonzero()
            nodes, ranks, paths = nodes.take(inside), ranks.take(inside), paths.take(inside)
        return np.concatenate(edges_by_level), np.concatenate(paths_by_level), last, last_ranks == 0

    def _grow(self, edges: NDArray[np.int64], nodes: NDArray[np.int64]) -> None:
        """Add a node at the end of each edge, (k,). nodes: ascending."""
        self._children.reshape(-1)[edges] = nodes
        parents, actions = np.divmod(edges, self._actions)
        self._rewards[nodes] = self._rewards.take(parents, axis=0)
        self._env.copy(parents, nodes)
        self._add(nodes, self._env.step(nodes, actions))

    def _add(self, nodes: NDArray[np.int64], rows: Sequence[AgentRows]) -> None:
        """Evaluate new nodes. rows: of all agents that report in them."""
        self._goes_on[nodes] = False
        for block in rows:
            self._rewards.reshape(-1)[block.envs * self._agents + block.agents] += block.rewards
        self._returns[nodes] = self._rewards.take(nodes, axis=0)
        for block in rows:
            if block.has_ended.any():
                block = block.take(np.flatnonzero(~block.has_ended))
            if len(block.envs):
                self._evaluate_nodes(block)

    def _evaluate_nodes(self, rows: AgentRows) -> None:
        nodes = rows.envs
        logits, values = self._evaluate(rows)
        self._logits[nodes] = log_probabilities(logits, rows.observations.get(ACTION_MASK))
        returns = self._returns.take(nodes, axis=0) + values
        self._returns[nodes] = returns
        self._player[nodes] = rows.agents
        self._value[nodes] = returns[np.arange(len(nodes)), rows.agents]
        self._goes_on[nodes] = True

    def _select(self, nodes: NDArray[np.int64], scores: NDArray[np.float64]) -> None:
        """scores: of Rule."""
        # Sorting integers that contain the place is much faster than `argsort`.
        keys = (scores * SCALE).astype(np.int64)
        keys *= self._places.size
        keys += self._places[:, np.newaxis]
        keys += np.where(self._logits.take(nodes, axis=0) > ILLEGAL, 0, LEAST)
        keys = keys.transpose(1, 0, 2).reshape(len(nodes), -1)
        keys.sort(axis=1)
        best = self._places.size - 1 - keys[:, : -self._leaves - 1 : -1] % self._places.size
        self._ranks[nodes], actions = np.divmod(best, self._actions)
        self._edges[nodes] = edges = nodes[:, np.newaxis] * self._actions + actions
        self._next[nodes] = self._children.take(edges)

    def _statistics(self, nodes: NDArray[np.int64]) -> Nodes:
        visits, sums = self._visits.take(nodes, axis=0), self._sums.take(nodes, axis=0)
        return Nodes(
            self._logits.take(nodes, axis=0),
            visits,
            sums,
            self._value.take(nodes),
            np.einsum("ij->i", visits),
            np.einsum("ij->i", sums),
        )


def log_probabilities(logits: NDArray[np.float32], mask: NDArray | None) -> NDArray[np.float64]:
    """Return the logarithms of the probabilities of legal actions, and ILLEGAL for others, (k, actions)."""
    probabilities = logits.astype(np.float64) if mask is None else np.where(mask != 0, logits, ILLEGAL)
    probabilities -= row_maxima(probabilities)
    probabilities -= np.log(row_sums(np.exp(probabilities)))
    return np.maximum(probabilities, ILLEGAL, out=probabilities)


def row_sums(array: NDArray) -> NDArray:
    """Return the sums of short rows (k, n), (k, 1): faster than `sum`."""
    return np.einsum("ij->i", array)[:, np.newaxis]


def row_maxima(array: NDArray) -> NDArray:
    """Return the maxima of short rows (k, n), (k, 1): faster than `max`."""
    return np.maximum.reduce(np.ascontiguousarray(array.T))[:, np.newaxis]
