"""Gates through real play between versions that are equally strong by construction: nobody should be promoted.

* *One policy under two numbers*: the games of a block are then one game with the places changed, and cancel exactly.
* *One policy, turned*: tic-tac-toe, where a graph and the same graph on the board turned by a quarter are two different
  policies of equal strength, since random openings favour no direction. Their games differ.

Versions are published in a registry of their own, matches are played by the real player, and the gate judges them.
"""

from __future__ import annotations

import numpy as np

from evaluation.gate import judge
from evaluation.player import Player
from evaluation.schedule import verdict
from league.config import GateConfig
from league.registry.registry import Registry
from tests.evaluation import examples

GATE = GateConfig(elo1=60, max_blocks=1000, nights=None)
QUARTER_TURN = tuple(int(square) for square in np.rot90(np.arange(9).reshape(3, 3)).reshape(-1))
CHUNK = 100


def turned(order: tuple[int, ...]) -> tuple[int, ...]:
    """The same preference for squares on a board that is turned by a quarter."""
    return tuple(QUARTER_TURN[square] for square in order)


def promoted(registry: Registry, same: bool, gates: int) -> int:
    """How many of so many gates promote the equal. Each has seeds, and so openings, of its own."""
    order = examples.CENTRE_FIRST
    graphs = [examples.graph(wins=True, order=each) for each in (order, order if same else turned(order))]
    champion, challenger = (examples.publish(registry, each).ref for each in graphs)
    row = registry.league(examples.LEAGUE)
    player = Player(row.config, registry)
    found = 0
    for seed in range(gates):
        schedule = verdict(row.config, row.interface, challenger, champion, GATE, seed)
        matches, decision = [], None
        while decision is None or decision.outcome is None:
            matches += player.play(schedule, range(len(matches), min(len(matches) + CHUNK, schedule.length)))
            decision = judge(GATE, matches, challenger)
        found += decision.outcome == "promote"
    return found
