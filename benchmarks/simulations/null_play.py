"""Gates with real games between equally strong versions, none of which should be promoted.

* *One policy under two numbers*: the games of a block are the same game with exchanged sides, and cancel exactly.
* *One policy, rotated*: in tic-tac-toe, a graph and the same graph on the board rotated by 90° are different policies
of equal strength, since random openings have no preferred direction. Their games differ.

Versions are published in a separate registry, matches are played by the real match worker, and the gate decides.
"""

from __future__ import annotations

import numpy as np

from evaluation.gating.gate import SequentialTest, decide_matches
from evaluation.matches.worker import MatchWorker
from evaluation.schedules.builders import verdict
from league.config.gate import GateConfig
from league.registry.registry import Registry
from tests.support.leagues import tictactoe

GATE = GateConfig(elo1=60, max_blocks=1000, nights=None)
QUARTER_TURN = tuple(int(square) for square in np.rot90(np.arange(9).reshape(3, 3)).reshape(-1))
CHUNK = 100


def rotated(order: tuple[int, ...]) -> tuple[int, ...]:
    """The same preference for squares on a board rotated by 90°."""
    return tuple(QUARTER_TURN[square] for square in order)


def promoted(registry: Registry, same: bool, gates: int) -> int:
    """How many of these gates promote an equally strong version. Each has its own seeds and openings."""
    order = tictactoe.CENTRE_FIRST
    graphs = [tictactoe.graph(wins=True, order=squares) for squares in (order, order if same else rotated(order))]
    champion, challenger = (tictactoe.publish(registry, graph).ref for graph in graphs)
    row = registry.leagues.get(tictactoe.LEAGUE)
    player = MatchWorker(row.config, registry)
    promotions = 0
    for seed in range(gates):
        schedule = verdict(row.config, row.interface, challenger, champion, GATE, seed)
        matches, decision = [], None
        while decision is None or decision.outcome is None:
            matches += player.play(schedule, range(len(matches), min(len(matches) + CHUNK, schedule.length)))
            decision = decide_matches(SequentialTest(GATE, challenger), matches)
        promotions += decision.outcome == "promote"
    return promotions
