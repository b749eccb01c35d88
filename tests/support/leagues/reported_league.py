"""Leagues with results, for reports."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from evaluation.gating.nightly import nightly
from evaluation.matches.tournament import evaluate
from league.config.league import LeagueConfig
from league.environments.building import interface
from league.registry.registry import Registry
from league.settings import Storage
from tests.support.leagues import tictactoe

CONFIG = tictactoe.config(play={"opening_plies": 2, "num_envs": 32})
HOSTILE = "</script><script>alert('mine')</script><img src=x onerror=alert(1)> & more"
ROLES = {"adversary": ["adversary_*"], "good": ["agent_*"]}


@contextmanager
def league_after_nightly(home: Path) -> Iterator[Registry]:
    """Tic-tac-toe with three versions of increasing strength after a nightly run, a round robin, a manual promotion
    with a hostile reason, and a rollback.
    """
    registry = tictactoe.registry(home, play=CONFIG.play.model_dump())
    for graph in (tictactoe.graph(), tictactoe.graph(wins=True), tictactoe.graph(wins=True, blocks=True)):
        tictactoe.publish(registry, graph)
    nightly(CONFIG, registry=registry)
    evaluate(tictactoe.LEAGUE, registry=registry, blocks=8)
    registry.aliases.set(tictactoe.LEAGUE, "champion", 1, expected=3, actor=HOSTILE, reason=HOSTILE)
    registry.aliases.rollback(tictactoe.LEAGUE, actor="me", reason="as it was")
    yield registry
    registry.close()


@contextmanager
def empty(home: Path) -> Iterator[Registry]:
    registry = tictactoe.registry(home)
    yield registry
    registry.close()


@contextmanager
def league_with_roles(home: Path) -> Iterator[Registry]:
    registry = Registry.open(Storage.at(home))
    config = LeagueConfig.from_mapping(
        {
            "league": tictactoe.LEAGUE,
            "environment": {"entry_point": "mpe2.simple_adversary_v3", "kwargs": {"max_cycles": 8}},
            "sides": ROLES,
            "policies": ROLES,
        }
    )
    registry.leagues.register(config, interface(config))
    evaluate(tictactoe.LEAGUE, ["script:random", "script:first"], registry=registry, blocks=10)
    yield registry
    registry.close()
