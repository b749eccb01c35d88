"""Leagues with results, to be reported."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from evaluation.nightly import nightly
from evaluation.tournament import evaluate
from league.config import LeagueConfig
from league.environments.building import interface
from league.registry.registry import Registry
from league.settings import Storage
from tests.evaluation import examples

CONFIG = examples.config(play={"opening_plies": 2, "copies": 2})
HOSTILE = "</script><script>alert('mine')</script><img src=x onerror=alert(1)> & more"
ROLES = {"adversary": ["adversary_*"], "good": ["agent_*"]}


@contextmanager
def of_a_night(home: Path) -> Iterator[Registry]:
    """Tic-tac-toe with three versions of growing strength after a night, a round robin, a promotion by hand with a
    hostile reason, and a rollback."""
    registry = examples.registry(home, play=CONFIG.play.model_dump())
    for graph in (examples.graph(), examples.graph(wins=True), examples.graph(wins=True, blocks=True)):
        examples.publish(registry, graph)
    nightly(CONFIG, registry=registry)
    evaluate(examples.LEAGUE, registry=registry, blocks=8)
    registry.set_alias(examples.LEAGUE, "champion", 1, expected=3, actor=HOSTILE, reason=HOSTILE)
    registry.rollback(examples.LEAGUE, actor="me", reason="as it was")
    yield registry
    registry.close()


@contextmanager
def empty(home: Path) -> Iterator[Registry]:
    registry = examples.registry(home)
    yield registry
    registry.close()


@contextmanager
def of_unlike_sides(home: Path) -> Iterator[Registry]:
    registry = Registry.open(Storage.at(home))
    config = LeagueConfig.from_mapping(
        {
            "league": examples.LEAGUE,
            "environment": {"entry_point": "mpe2.simple_adversary_v3", "kwargs": {"max_cycles": 8}},
            "sides": ROLES,
            "policies": ROLES,
        }
    )
    registry.register(config, interface(config))
    evaluate(examples.LEAGUE, ["script:random", "script:first"], registry=registry, blocks=10)
    yield registry
    registry.close()
