"""A league of tic-tac-toe with versions for gate tests: their graphs and the configuration."""

from pathlib import Path

from league.config.league import LeagueConfig
from league.registry.aliases import ANY
from league.registry.registry import Registry
from tests.support.leagues import tictactoe


def config(**gate: object) -> LeagueConfig:
    """The league with these settings of its gate."""
    return tictactoe.config(play={"opening_plies": 2, "num_envs": 32}, gate=gate)


CONFIG = config()

WEAK = tictactoe.graph()

MIDDLING = tictactoe.graph(wins=True)

STRONG = tictactoe.graph(wins=True, blocks=True)

STRONGEST = tictactoe.graph(wins=True, blocks=True, order=tictactoe.CENTRE_FIRST)


def league_of(home: Path, *graphs: bytes, config: LeagueConfig = CONFIG) -> Registry:
    registry = tictactoe.registry(home, play=config.play.model_dump(), gate=config.gate.model_dump())
    for graph in graphs:
        tictactoe.publish(registry, graph)
    return registry


def promote(registry: Registry, *versions: int, actor: str = "me", reason: str = "by hand") -> Registry:
    """Make each of the versions champion, one after the other."""
    for version in versions:
        registry.aliases.set(tictactoe.LEAGUE, "champion", version, expected=ANY, actor=actor, reason=reason)
    return registry


def reconfigure(registry: Registry, league: LeagueConfig) -> None:
    """Register another configuration of the league, whose spaces are the same."""
    registry.leagues.register(league, registry.leagues.get(tictactoe.LEAGUE).interface)
