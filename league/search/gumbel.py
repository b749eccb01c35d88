"""Gumbel's sequential halving: Danihelka et al., 2022, "Policy improvement by planning with Gumbel".

At the root, the actions with the highest g + logits are considered, where g is Gumbel noise, or 0 in a search without
noise. Simulations are distributed evenly; in each phase the better half remains, by g + logits + σ(q). Below the root,
an action is selected such that visits follow the improved policy π' = softmax(logits + σ(q)). σ(q) is
(50 + the most visits) · (1 + q) / 2: the paper's constants, for values from -1 to 1. Actions without visits have the
value of equation 33 of the paper.
"""

import math

import numpy as np
from numpy.typing import NDArray

from league.policies.draws import Generators
from league.search.array_trees import row_maxima, row_sums
from league.search.rules import ILLEGAL, SHARE, Node, Nodes, Score

MOST_CONSIDERED = 16
"""Actions that are considered at the root, at most."""
VISIT_OFFSET = 50
LAST = 2.0**20
"""The negative score of an action of the root that a round does not visit."""
TINY = float(np.finfo(float).tiny)


class SequentialHalving:
    """Selects actions as in Gumbel AlphaZero. A search has as much noise as its generators give."""

    def start(self, roots: Nodes, simulations: int, leaves: int, rng: Generators | None) -> NDArray[np.int64]:
        """See Rule."""
        count, actions = roots.logits.shape
        self._noise: NDArray[np.float64] = np.zeros((count, actions))
        if rng is not None:
            self._noise[:] = [generator.gumbel(size=actions) for generator in rng]
        considered = np.minimum((roots.logits > ILLEGAL).sum(axis=1), MOST_CONSIDERED)
        numbers, kinds = np.unique(considered, return_inverse=True)
        schedules = [halving(number, simulations, leaves) for number in numbers.tolist()]
        table = np.zeros((len(numbers), max(map(len, schedules)), 3), dtype=np.int64)
        for kind, schedule in enumerate(schedules):
            table[kind, : len(schedule)] = schedule
        sizes, self._visits, self._times = table[kinds].transpose(2, 0, 1)
        """Visits of the actions of the root that each round takes, and how often it visits them, (k, rounds)."""
        return sizes

    def scores(self, nodes: Nodes, roots: int, number: int, leaves: int) -> NDArray[np.float64]:
        """See Rule."""
        sent = np.arange(leaves)[:, np.newaxis, np.newaxis]
        logits = improved_logits(nodes)
        policy = np.exp(logits - row_maxima(logits))
        policy /= row_sums(policy)
        scores = policy - (nodes.visits + sent) / (1 + nodes.total_visits)[:, np.newaxis]
        is_next = (nodes.visits[:roots] == self._visits[:, number, np.newaxis]) & (
            sent < self._times[:, number, np.newaxis]
        )
        values = np.maximum(logits[:roots] + self._noise, 1 - LAST)
        scores[:, :roots] = np.where(is_next, values, -LAST)
        return scores

    def score(self, node: Node, root: int | None, number: int) -> Score:
        """See Rule."""
        logits, visits, total = _improved_logits_of(node), node.visits, 1 + node.total_visits
        if root is not None:
            noise = self._noise[root].tolist()
            expected_visits, times = self._visits[root, number], self._times[root, number]

            def root_score(edge: int, sent: int) -> float:
                is_next = visits[edge] == expected_visits and sent < times
                return max(logits[edge] + noise[node.actions[edge]], 1 - LAST) if is_next else -LAST

            return root_score
        highest = max(logits)
        shares = [math.exp(logit - highest) for logit in logits]
        scale = sum(shares)
        return lambda edge, sent: shares[edge] / scale - (visits[edge] + sent) / total

    def result(self, roots: Nodes) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """See Rule. The best action is that of the most visited ones with the highest score."""
        logits = improved_logits(roots)
        is_most = roots.visits == row_maxima(roots.visits)
        actions = np.where(is_most, logits + self._noise, -np.inf).argmax(axis=1)
        return actions, np.where(roots.logits > ILLEGAL, logits, ILLEGAL)


def improved_logits(nodes: Nodes) -> NDArray[np.float64]:
    """Return logits + σ(q), (k, actions); unspecified for illegal actions."""
    is_visited = nodes.visits > 0
    priors = np.where(is_visited, np.exp(nodes.logits), 0.0)
    means = nodes.sums / np.maximum(nodes.visits, 1)
    # Equation 33: the node's evaluation, and the mean of the visited actions, weighted by their priors.
    weighted = row_sums(priors * means) / np.maximum(row_sums(priors), TINY)
    visits = nodes.total_visits[:, np.newaxis]
    mixed = (nodes.value[:, np.newaxis] + visits * weighted) / (1 + visits)
    values = np.where(is_visited, means, mixed)
    return nodes.logits + (VISIT_OFFSET + row_maxima(nodes.visits)) / 2 * (1 + values)


def _improved_logits_of(node: Node) -> list[float]:
    """The same as `improved_logits` for one node."""
    visits, sums, total = node.visits, node.sums, node.total_visits
    mixed, scale = node.value, (VISIT_OFFSET + max(visits)) / 2
    if total:
        columns = [
            (prior, values / count) for prior, values, count in zip(node.priors, sums, visits, strict=True) if count
        ]
        weights = sum(prior for prior, _ in columns)
        weighted = sum(prior * mean for prior, mean in columns) / max(weights, TINY)
        mixed = (mixed + total * weighted) / (1 + total)
    return [
        logit + scale * (1 + (values / count if count else mixed))
        for logit, values, count in zip(node.logits, sums, visits, strict=True)
    ]


def halving(considered: int, simulations: int, leaves: int) -> list[tuple[int, int, int]]:
    """Return for each round its simulations, the visits that the actions must have among which it takes the best, and
    how often it visits each of them.

    There are ⌈log₂ considered⌉ phases with equally many simulations. After the last one, the best two actions remain.
    A round visits each of the remaining actions once, up to `leaves` of them: these are different edges of the root, so
    no simulation depends on another one of its round. If there are few of them, it visits each up to a SHARE-th as
    often as before.
    """
    phases = max(1, math.ceil(math.log2(considered)))
    rounds: list[tuple[int, int, int]] = []
    visits, remaining, left = 0, considered, simulations
    while left:
        end = visits + max(1, simulations // (phases * remaining))
        while visits < end and left:
            times = max(1, min(visits // SHARE, leaves // remaining, left // remaining, end - visits))
            for first in range(0, min(left, remaining * times), leaves):
                rounds.append((min(leaves, remaining * times - first, left), visits, times))
                left -= rounds[-1][0]
            visits += times
        remaining = max(min(2, considered), remaining // 2)
    return rounds
