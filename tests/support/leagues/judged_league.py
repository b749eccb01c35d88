"""A league of tic-tac-toe with versions for gate tests: their graphs and the configuration."""

from pathlib import Path

from league.config.league import LeagueConfig
from league.registry.registry import Registry
from tests.support.leagues import tictactoe

CONFIG = tictactoe.config(play={"opening_plies": 2, "num_envs": 32})

WEAK = tictactoe.graph()

MIDDLING = tictactoe.graph(wins=True)

STRONG = tictactoe.graph(wins=True, blocks=True)

STRONGEST = tictactoe.graph(wins=True, blocks=True, order=tictactoe.CENTRE_FIRST)


def league_of(home: Path, *graphs: bytes, config: LeagueConfig = CONFIG) -> Registry:
    registry = tictactoe.registry(home, play=config.play.model_dump(), gate=config.gate.model_dump())
    for graph in graphs:
        tictactoe.publish(registry, graph)
    return registry
