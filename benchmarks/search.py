"""How fast is tree search, compared with its evaluations by the network?

Connect four from random positions, 100 simulations in each of 256 games, and 64 in a single game. The network is a
2×256 multilayer perceptron with random weights, in ONNX Runtime with one thread. Times are processor time; those of a
single game are scaled to a machine that needs 1.5 s for 20 million additions. The peer of many games repeats the
search's calls of the network and does nothing else, and that of one game is `peers/plain_search.py`; they alternate
with the search, and a value is the median over the rounds.
"""

from collections.abc import Iterator
from statistics import median
from time import process_time

import numpy as np
from numpy.typing import NDArray

from benchmarks.harness import Quick, Target, additions
from benchmarks.peers.plain_search import plain_search
from league.environments.vector.connect_four import COLUMNS, ConnectFour
from league.environments.vector.random_actions import acting, legal_actions
from league.environments.vector.vector_env import AgentRows, VectorEnv
from league.policies.graph_runs import open_session
from league.policies.policy import Arrays
from league.search.gumbel import SequentialHalving
from league.search.puct import PUCT
from league.search.rules import Estimates, Rule
from league.search.search import Search
from league.spaces import ACTION_MASK, OBSERVATION, Discrete
from tests.support.policies.graphs import masked_mlp

GAMES, SIMULATIONS, PLIES = 256, 100, 6
PER_SECOND, RATIO = 1500, 2.5
ALONE = 64
SECONDS = 1.5
"""That the additions of `harness` take on the machine to which times are scaled."""
RULES: dict[str, tuple[Rule, float]] = {"PUCT": (PUCT(), 4), "sequential halving": (SequentialHalving(), 5)}
"""The rules, and in how many milliseconds a search of one game should end."""


class Network:
    """A policy and its value. calls: the observations of each call."""

    def __init__(self) -> None:
        self.session = open_session(masked_mlp(hidden=(256, 256), has_value=True))
        self.calls: list[Arrays] = []

    def __call__(self, rows: AgentRows) -> Estimates:
        feed = {name: rows.observations[name] for name in (OBSERVATION, ACTION_MASK)}
        self.calls.append(feed)
        logits, value = self.evaluate(feed)
        return Estimates(logits, np.where(rows.agents == np.array([[0], [1]]), value, -value).T)

    def evaluate(self, feed: Arrays) -> list[np.ndarray]:
        """Run the graph."""
        outputs: list[np.ndarray] = self.session.run(["action_dist_inputs", "value"], feed)
        return outputs


def positions(env: VectorEnv, copies: NDArray[np.int64]) -> list[AgentRows]:
    """Play some random moves in all games: too few for a win."""
    generator, rows = np.random.default_rng(0), env.reset(copies, copies)
    for _ in range(PLIES):
        rows = env.step(acting(rows), legal_actions(rows, [Discrete(n=COLUMNS)] * 2, generator))
    return [block.take(np.flatnonzero(~block.has_ended)) for block in rows]


def main(quick: Quick = False) -> Iterator[Target]:
    """Measure both rules."""
    network, rounds = Network(), 3 if quick else 15
    for name, (rule, most_ms) in RULES.items():
        search = Search(ConnectFour, network, rule, games=GAMES, simulations=SIMULATIONS, num_actions=COLUMNS)
        seconds, ratios = [], []
        for _ in range(rounds):
            network.calls.clear()
            rows = positions(search.env, search.roots)
            began = process_time()
            search.run(rows)
            seconds.append(process_time() - began)
            began = process_time()
            for feed in network.calls:
                network.evaluate(feed)
            ratios.append(seconds[-1] / (process_time() - began))
        yield Target(name, GAMES / median(seconds), "/s", at_least=PER_SECOND)
        yield Target(name, median(ratios), "×", at_most=RATIO, peer="the network alone")
        search = Search(ConnectFour, network, rule, games=1, simulations=ALONE, num_actions=COLUMNS)
        seconds, ratios = [], []
        for _ in range(20 * rounds):
            rows = positions(search.env, search.roots)
            began = process_time()
            search.run(rows)
            seconds.append(process_time() - began)
            began = process_time()
            plain_search(network.session, ALONE)
            ratios.append(seconds[-1] / (process_time() - began))
        measured, speed = 1000 * median(seconds), additions()
        note = f"{measured:.1f} ms, {speed:.2f} s for the additions"
        name = f"{name}, one game, {ALONE} simulations"
        yield Target(name, measured * SECONDS / speed, "ms", at_most=most_ms, note=note)
        yield Target(name, median(ratios), "×", peer="a plain search")
