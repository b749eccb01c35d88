"""Trees of a few games with a Python object for each node: for few nodes, calls of NumPy cost more."""

import math
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from league.environments.vector.vector_env import AgentRows, VectorEnv
from league.search.rules import ILLEGAL, SCALE, Evaluate, Node, Nodes, Rule, Score
from league.spaces import ACTION_MASK


class ObjectTrees:
    """See `league.search.search.Trees`."""

    def __init__(
        self, env: VectorEnv, roots: NDArray[np.int64], evaluate: Evaluate, rule: Rule, num_actions: int
    ) -> None:
        """roots: copies of `env`. Those after each of them are for its tree."""
        self._env, self._copies, self._evaluate, self._rule = env, roots.tolist(), evaluate, rule
        self._num_actions = num_actions

    def begin(self, rows: Sequence[AgentRows]) -> Nodes:
        """See Trees."""
        copies = self._copies[: sum(len(block.envs) for block in rows)]
        self._roots = [Node(copy, [0.0] * len(self._env.possible_agents)) for copy in copies]
        self._unused = [copy + 1 for copy in copies]
        self._add(self._roots, rows)
        return self.roots()

    def simulate(self, number: int, sizes: NDArray[np.int64]) -> None:
        """See Trees."""
        paths: list[tuple[list[tuple[Node, int]], Node]] = []
        grown: list[tuple[Node, int, Node]] = []
        for game, (root, size) in enumerate(zip(self._roots, sizes.tolist(), strict=True)):
            for _ in range(size):
                path, node = list[tuple[Node, int]](), root
                while node.actions:
                    edges = node.edges
                    if edges is None:
                        score = self._rule.score(node, game if node is root else None, number)
                        edges = node.edges = _edges(score, len(node.actions))
                    edge = next(edges)
                    path.append((node, edge))
                    child = node.children[edge]
                    if child is None:
                        child = node.children[edge] = Node(self._unused[game], node.rewards.copy())
                        self._unused[game] += 1
                        grown.append((node, node.actions[edge], child))
                    node = child
                paths.append((path, node))
        if grown:
            parents, actions, nodes = zip(*grown, strict=True)
            copies = np.array([node.copy for node in nodes])
            self._env.copy(np.array([parent.copy for parent in parents]), copies)
            self._add(nodes, self._env.step(copies, np.array(actions)))
        for path, leaf in paths:
            returns = leaf.returns
            for node, edge in path:
                value = returns[node.player]
                node.visits[edge] += 1
                node.sums[edge] += value
                node.total_visits += 1
                node.total += value
                node.edges = None

    def roots(self) -> Nodes:
        """See Trees."""
        logits, visits, sums = (
            self._all_actions("logits", ILLEGAL),
            self._all_actions("visits"),
            self._all_actions("sums"),
        )
        columns = [[getattr(root, name) for root in self._roots] for name in ("value", "total_visits", "total")]
        return Nodes(logits, visits, sums, *np.array(columns, dtype=np.float64))

    def lines(self, actions: NDArray[np.int64], moves: int) -> NDArray[np.int64]:
        """See Trees."""
        lines = np.full((len(actions), moves), -1)
        for line, root, action in zip(lines, self._roots, actions.tolist(), strict=True):
            node, edge = root, root.actions.index(action)
            for move in range(moves):
                line[move] = node.actions[edge]
                child = node.children[edge]
                if child is None or not child.total_visits:
                    break
                node, edge = child, child.visits.index(max(child.visits))
        return lines

    def _all_actions(self, name: str, missing: float = 0.0) -> NDArray[np.float64]:
        array = np.full((len(self._roots), self._num_actions), missing)
        for row, root in zip(array, self._roots, strict=True):
            row[root.actions] = getattr(root, name)
        return array

    def _add(self, nodes: Sequence[Node], rows: Sequence[AgentRows]) -> None:
        """Evaluate new nodes. rows: of all agents that report in them."""
        by_copy = {node.copy: node for node in nodes}
        for block in rows:
            for copy, agent, reward in zip(
                block.envs.tolist(), block.agents.tolist(), block.rewards.tolist(), strict=True
            ):
                by_copy[copy].rewards[agent] += reward
        for block in rows:
            has_ended = block.has_ended
            if np.count_nonzero(has_ended):
                block = block.take(np.flatnonzero(~has_ended))
            if len(block.envs):
                self._evaluate_nodes([by_copy[copy] for copy in block.envs.tolist()], block)

    def _evaluate_nodes(self, nodes: Sequence[Node], rows: AgentRows) -> None:
        logits, values = self._evaluate(rows)
        mask = rows.observations.get(ACTION_MASK)
        masks = [[1] * self._num_actions] * len(nodes) if mask is None else mask.tolist()
        columns = (nodes, rows.agents.tolist(), logits.tolist(), masks, values.tolist())
        for node, player, outputs, legal, estimates in zip(*columns, strict=True):
            node.player = player
            node.returns = [reward + value for reward, value in zip(node.rewards, estimates, strict=True)]
            node.value = node.returns[player]
            node.actions = actions = [action for action, is_legal in enumerate(legal) if is_legal]
            if len(actions) < len(outputs):
                outputs = [outputs[action] for action in actions]
            highest = max(outputs)
            shares = [math.exp(output - highest) for output in outputs]
            scale = sum(shares)
            subtracted = highest + math.log(scale)
            node.priors = [share / scale for share in shares]
            node.logits = [output - subtracted for output in outputs]
            node.visits, node.sums, node.children = [0] * len(actions), [0.0] * len(actions), [None] * len(actions)


def _edges(score: Score, count: int) -> Iterator[int]:
    """Yield where the simulations of a round go from a node, given the scores of its actions."""
    sent = [0] * count
    keys = [int(score(edge, 0) * SCALE) for edge in range(count)]
    while True:
        highest = max(keys)
        edge = keys.index(highest)
        if sent[edge]:  # of equal scores, the first in `Rule.scores`
            edge = min((edge for edge, key in enumerate(keys) if key == highest), key=sent.__getitem__)
        yield edge
        sent[edge] += 1
        keys[edge] = int(score(edge, sent[edge]) * SCALE)
