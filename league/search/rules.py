"""What a rule of selecting actions gets and returns, for the trees of many games in arrays and of a few in objects."""

from collections.abc import Callable, Iterator
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from league.environments.vector.vector_env import AgentRows
from league.policies.draws import Generators

ILLEGAL = -1e9
"""Logit of an illegal action."""
SCALE = 2.0**24
"""Scores are compared as integers, multiplied by this: equal ones stay equal when they are computed in another way."""
SHARE = 4
"""A round has at most a SHARE-th of the simulations before it, or one: while a tree is small, each result changes where
to look next."""


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
    """Statistics of k nodes, all float64.

    Attributes:
        logits: Logarithms of the prior probabilities of the actions, (k, actions); ILLEGAL for illegal ones.
        visits: Simulations through each action, (k, actions).
        sums: Sums of the values that these reached, for the agent that acts in the node, (k, actions).
        value: The evaluation of the node for this agent, (k,).
        total_visits: Sum of `visits`, (k,).
        total: Sum of `sums`, (k,).
    """

    logits: NDArray[np.float64]
    visits: NDArray[np.float64]
    sums: NDArray[np.float64]
    value: NDArray[np.float64]
    total_visits: NDArray[np.float64]
    total: NDArray[np.float64]


class Node:
    """One node. Until it is evaluated, and if its game is over, it has no actions.

    Attributes:
        copy: The copy of the environment that has its state.
        returns: Rewards of each agent on the path from the root to the node, with its evaluation.
        player: The agent that acts.
        actions: Its legal actions. The following lists have an element for each of them.
        logits, priors: Prior probabilities of the actions, and their logarithms.
        visits, sums, value, total_visits, total: See Nodes.
        children: None for an action without a node.
        edges: Where the next simulations of a round go; None if the statistics have changed.
    """

    __slots__ = (
        "actions", "children", "copy", "edges", "logits", "player", "priors", "returns", "rewards", "sums", "total",
        "total_visits", "value", "visits",
    )  # fmt: skip

    actions: list[int]
    children: list["Node | None"]
    edges: Iterator[int] | None
    logits: list[float]
    player: int
    priors: list[float]
    sums: list[float]
    value: float
    visits: list[int]

    def __init__(self, copy: int, rewards: list[float]) -> None:
        self.copy, self.rewards, self.returns = copy, rewards, rewards
        self.actions, self.edges = [], None
        self.total_visits, self.total = 0, 0.0


Score = Callable[[int, int], float]
"""Of an index of `Node.actions`, and of the simulations that a round has sent through this action before."""


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

    def scores(self, nodes: Nodes, roots: int, number: int, leaves: int) -> NDArray[np.float64]:
        """Return the scores of sending a further simulation of a round through each action of each node, if the round
        has sent 0, 1, … `leaves` - 1 others through it, (leaves, k, actions), descending, from -2²⁰ to 2²⁰; those with
        the highest scores are sent, of equal ones in the order of the axes.

        Args:
            nodes: k nodes. The first ones are the roots, as many as `roots` says.
            number: Of the round, from 0.
        """

    def score(self, node: Node, root: int | None, number: int) -> Score:
        """Return `scores` of a single node, for trees of objects.

        Args:
            root: The number of the root; None for other nodes.
            number: Of the round, from 0.
        """

    def result(self, roots: Nodes) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return the best action in each root, (k,), and the logits of an improved policy, (k, actions)."""
