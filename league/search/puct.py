"""PUCT, the selection of AlphaZero: Silver et al., 2018, "A general reinforcement learning algorithm that masters
chess, shogi, and Go through self-play".

The action with the highest Q(s, a) + c · P(s, a) · √N(s) / (1 + N(s, a)) is selected. Q is the mean value of the
simulations through an action, or without any the mean value of the node; N(s) includes the node's own evaluation. The
most visited action is played.
"""

import math

import numpy as np
from numpy.typing import NDArray

from league.policies.draws import Generators
from league.search.rules import ILLEGAL, SHARE, Node, Nodes, Score

EXPLORATION = 1.5
"""The constant c. Silver et al. let it grow from 1.25, by 0.04 in 800 simulations."""


class PUCT:
    """Selects actions by PUCT. Without randomness.

    Within a round, a simulation that is not evaluated yet counts as a lost one: virtual loss, as in AlphaGo Zero.
    """

    def start(self, roots: Nodes, simulations: int, leaves: int, rng: Generators | None) -> NDArray[np.int64]:  # noqa: ARG002
        """See Rule."""
        sizes: list[int] = []
        before = 0
        while before < simulations:
            sizes.append(min(leaves, max(1, before // SHARE), simulations - before))
            before += sizes[-1]
        return np.tile(sizes, (len(roots.logits), 1))

    def scores(self, nodes: Nodes, roots: int, number: int, leaves: int) -> NDArray[np.float64]:  # noqa: ARG002
        """See Rule. Roots are nodes like others."""
        losses = np.arange(leaves, dtype=np.float64)[:, np.newaxis, np.newaxis]
        total = 1 + nodes.total_visits
        mean = ((nodes.value + nodes.total) / total)[:, np.newaxis]
        # Without a visit, the mean value of the node counts as one.
        scores = np.where(nodes.visits > 0, nodes.sums, mean) - losses
        scores /= np.maximum(nodes.visits, 1) + losses
        scores += np.exp(nodes.logits) * (EXPLORATION * np.sqrt(total))[:, np.newaxis] / (1 + nodes.visits + losses)
        return scores

    def score(self, node: Node, root: int | None, number: int) -> Score:  # noqa: ARG002
        """See Rule."""
        total = 1 + node.total_visits
        mean, urgency = (node.value + node.total) / total, EXPLORATION * math.sqrt(total)
        visits, sums, priors = node.visits, node.sums, node.priors

        def score(edge: int, losses: int) -> float:
            count = visits[edge]
            value = (sums[edge] if count else mean) - losses
            return value / ((count or 1) + losses) + priors[edge] * urgency / (1 + count + losses)

        return score

    def result(self, roots: Nodes) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """See Rule. The improved policy is the share of visits. Of equally visited actions, the better one is best."""
        best = roots.visits == roots.visits.max(axis=1, keepdims=True)
        actions = np.where(best, roots.sums, -np.inf).argmax(axis=1)
        with np.errstate(divide="ignore"):
            return actions, np.maximum(np.log(roots.visits / roots.total_visits[:, np.newaxis]), ILLEGAL)
