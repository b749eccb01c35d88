"""Tree search over many games at once. Each round evaluates a few leaves of each game, all of them in one batch.

Node i of game g is the copy g · (simulations + 1) + i of a vectorised environment, which holds its state. Node 0 is the
root. All statistics are arrays over these copies.

A simulation follows edges from the root to an edge without a node, steps the environment there, evaluates the new node,
and adds its value to the edges of the path. The simulations of a round start with the same statistics: a node sends the
first one that arrives along its best edge, and further ones as if those before them were visits already. Which edge the
first, the second, … takes depends on the node's own statistics only. It is computed when these have changed, for the
nodes of all paths at once.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from time import monotonic
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from league.environments.vector.vector_env import AgentRows, VectorEnv
from league.policies.draws import Generators
from league.spaces import ACTION_MASK

ILLEGAL = np.float32(-1e9)
"""Logit of an illegal action."""
SCALE, LEAST = np.float32(2**24), -(2**62)
"""Of scores as integers, and what an illegal action's is less."""
LEAVES = 8
"""The most leaves of a game that a round evaluates. It does not depend on the number of games, so neither do results.
With 1, each simulation sees the values of all those before it."""


class Estimates(NamedTuple):
    """What is expected in k positions.

    Attributes:
        logits: Of the actions of the agent that must act, (k, actions) float32. Those of illegal actions are ignored.
        values: Sum of the rewards that each agent gets from here on, (k, agents) float32, from -1 to 1.
    """

    logits: NDArray[np.float32]
    values: NDArray[np.float32]


Evaluate = Callable[[AgentRows], Estimates]
"""Evaluates positions, given the rows of the agents that must act. The result of a row must not depend on others."""


class Nodes(NamedTuple):
    """Statistics of k nodes, all float32.

    Attributes:
        logits: Logarithms of the prior probabilities of the actions, (k, actions); ILLEGAL for illegal ones.
        visits: Simulations through each action, (k, actions).
        sums: Sums of the values that these reached, for the agent that acts in the node, (k, actions).
        value: The evaluation of the node for this agent, (k,).
        total_visits: Sum of `visits`, (k,).
        total: Sum of `sums`, (k,).
    """

    logits: NDArray[np.float32]
    visits: NDArray[np.float32]
    sums: NDArray[np.float32]
    value: NDArray[np.float32]
    total_visits: NDArray[np.float32]
    total: NDArray[np.float32]


class Rule(Protocol):
    """How a search selects actions. It has no state besides that of `start`."""

    def start(self, roots: Nodes, simulations: int, leaves: int, rng: Generators | None) -> NDArray[np.int64]:
        """Begin a search.

        Args:
            roots: k positions.
            simulations: Of each position.
            leaves: The most simulations of a position in a round.
            rng: A generator for each root; None for a search without noise.

        Returns:
            The simulations of each position in each round, (k, rounds).
        """

    def scores(self, nodes: Nodes, roots: int, number: int, leaves: int) -> NDArray[np.float32]:
        """Return the scores of sending a further simulation of a round through each action of each node, if the round
        has sent 0, 1, … `leaves` - 1 others through it, (leaves, k, actions), descending, from -2²⁰ to 2²⁰; those with
        the highest scores are sent.

        Args:
            nodes: k nodes. The first ones are the roots, as many as `roots` says.
            number: Of the round, from 0.
        """

    def result(self, roots: Nodes) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """Return the best action in each root, (k,), and the logits of an improved policy, (k, actions)."""


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
    ) -> None:
        """make: number of copies → environment. num_actions: of each agent. leaves: see LEAVES."""
        copies = games * (simulations + 1)
        self.env, self.roots = make(copies), np.arange(games) * (simulations + 1)
        self._evaluate, self._rule, self._simulations, self._leaves = evaluate, rule, simulations, leaves
        self._agents, self._actions = len(self.env.possible_agents), num_actions
        self._logits, self._visits, self._sums = np.zeros((3, copies, num_actions), dtype=np.float32)
        self._value = np.zeros(copies, dtype=np.float32)
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
        self._rewards, self._returns = np.zeros((2, copies, self._agents), dtype=np.float32)
        """Rewards of each agent on the path from the root to the node, and these with the evaluation of the node."""

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
        roots = self.roots[: sum(len(block.envs) for block in rows)]
        used = slice(0, len(roots) * (self._simulations + 1))
        for array in (self._children, self._visits, self._sums):
            array[used] = 0
        self._rewards[roots] = 0
        self._add(roots, rows)
        self._goes_on[0] = False
        nodes, changed = self._nodes(roots), roots
        sizes = self._rule.start(nodes, self._simulations, self._leaves, rng)
        new = roots + 1
        for number, size in enumerate(sizes.T):
            self._select(changed, self._rule.scores(nodes, len(roots), number, self._leaves))
            changed = np.concatenate([roots, self._simulate(roots, size, new)])
            nodes = self._nodes(changed)
            new = new + size
            if monotonic() > deadline:
                break
        nodes = Nodes(*(array[: len(roots)] for array in nodes))
        actions, logits = self._rule.result(nodes)
        values = (nodes.value + nodes.total) / (1 + nodes.total_visits)
        return SearchResult(actions, logits, nodes.visits.astype(np.int64), values, self._lines(actions, moves))

    def _simulate(self, roots: NDArray[np.int64], size: NDArray[np.int64], new: NDArray[np.int64]) -> NDArray[np.int64]:
        """Run the simulations of a round, and return the nodes below the roots whose statistics are new.

        size, new: simulations of each game, and the first of the nodes that they may add, (games,).
        """
        ranks = np.arange(size.sum()) - (size.cumsum() - size).repeat(size)
        edges, paths, last, is_first = self._descend(roots.repeat(size), ranks)
        (added,) = ((self._children.take(last) == 0) & is_first).nonzero()
        grown = (new.repeat(size) + ranks).take(added)
        if len(added):
            self._grow(last.take(added), grown)
        leaves = self._children.take(last)
        nodes = edges // self._actions
        values = self._returns.take(leaves.take(paths) * self._agents + self._player.take(nodes))
        np.add.at(self._visits.reshape(-1), edges, np.float32(1))
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

    def _lines(self, actions: NDArray[np.int64], moves: int) -> NDArray[np.int64]:
        lines = np.full((len(actions), moves), -1)
        nodes, games = self.roots[: len(actions)], np.arange(len(actions))
        for move in range(moves):
            lines[games, move] = actions
            children = self._children.take(nodes * self._actions + actions)
            (inside,) = (self._goes_on.take(children) & self._visits.take(children, axis=0).any(axis=1)).nonzero()
            nodes, games = children.take(inside), games.take(inside)
            actions = self._visits.take(nodes, axis=0).argmax(axis=1)
        return lines

    def _grow(self, edges: NDArray[np.int64], nodes: NDArray[np.int64]) -> None:
        """Add a node at the end of each edge, (k,). nodes: ascending."""
        self._children.reshape(-1)[edges] = nodes
        parents, actions = np.divmod(edges, self._actions)
        self._rewards[nodes] = self._rewards.take(parents, axis=0)
        self.env.copy(parents, nodes)
        self._add(nodes, self.env.step(nodes, actions))

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
        mask = rows.observations.get(ACTION_MASK)
        self._logits[nodes] = log_probabilities(logits, mask)
        returns = self._returns.take(nodes, axis=0) + values
        self._returns[nodes] = returns
        self._player[nodes] = rows.agents
        self._value[nodes] = returns[np.arange(len(nodes)), rows.agents]
        self._goes_on[nodes] = True

    def _select(self, nodes: NDArray[np.int64], scores: NDArray[np.float32]) -> None:
        """scores: of Rule. Equal ones are taken in the order of the axes."""
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

    def _nodes(self, nodes: NDArray[np.int64]) -> Nodes:
        visits, sums = self._visits.take(nodes, axis=0), self._sums.take(nodes, axis=0)
        return Nodes(
            self._logits.take(nodes, axis=0),
            visits,
            sums,
            self._value.take(nodes),
            np.einsum("ij->i", visits),
            np.einsum("ij->i", sums),
        )


def log_probabilities(logits: NDArray[np.float32], mask: NDArray | None) -> NDArray[np.float32]:
    """Return the logarithms of the probabilities of legal actions, and ILLEGAL for others, (k, actions)."""
    if mask is not None:
        logits = np.where(mask != 0, logits, ILLEGAL)
    logits = logits - row_maxima(logits)
    logits -= np.log(row_sums(np.exp(logits)))
    return np.maximum(logits, ILLEGAL, out=logits)


def row_sums(array: NDArray) -> NDArray:
    """Return the sums of short rows (k, n), (k, 1): faster than `sum`."""
    return np.einsum("ij->i", array)[:, np.newaxis]


def row_maxima(array: NDArray) -> NDArray:
    """Return the maxima of short rows (k, n), (k, 1): faster than `max`."""
    return np.maximum.reduce(np.ascontiguousarray(array.T))[:, np.newaxis]
