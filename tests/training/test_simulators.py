"""Leagues whose games run in simulators train, publish and evaluate like others."""

import importlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from evaluation.matches import tournament
from league.config.league import LeagueConfig
from league.environments.building import interface
from league.errors import ConfigError
from league.registry.registry import Registry
from tests.support import simulators
from tests.support.simulators import LEAGUE, external, pettingzoo, simulating
from training.export.publish import Checkpoint, publish
from training.runs.trial import build_algorithm

SMALL = {"hidden": [8], "runners": 0, "num_envs": 4}
ON_POLICY = SMALL | {"train_batch_size": 64, "minibatch_size": 64, "epochs": 1}
OFF_POLICY = SMALL | {"learning_starts": 32, "batch_size": 32, "replay_capacity": 500}
CASES: dict[str, tuple[str, dict[str, Any]]] = {
    "ppo": ("pettingzoo.classic.tictactoe_v3", ON_POLICY | {"opening_plies": 2, "opponents": ["script:random"]}),
    "central": ("mpe2.simple_spread_v3", ON_POLICY | {"critic": "central"}),
    "recurrent": ("pettingzoo.classic.rps_v2", ON_POLICY | {"recurrence": {"width": 8, "sequence": 8}}),
    "dqn": ("pettingzoo.classic.tictactoe_v3", {"algorithm": "dqn"} | OFF_POLICY),
    "qmix": ("mpe2.simple_spread_v3", {"algorithm": "qmix"} | OFF_POLICY),
}


@pytest.fixture(params=[pytest.param("ppo", marks=[pytest.mark.slow, pytest.mark.e2e]), *list(CASES)[1:]])
def case(request: pytest.FixtureRequest) -> tuple[LeagueConfig, Any]:
    entry_point, training = CASES[request.param]
    document = {"league": "stock", "environment": {"entry_point": entry_point}, "training": training}
    if "spread" in entry_point:
        document["sides"] = {"team": ["agent_*"]}
    module = importlib.import_module(entry_point)
    return LeagueConfig.from_mapping(document), getattr(
        module, "parallel_env" if "tictactoe" not in entry_point else "env"
    )


@pytest.fixture
def opened(case: tuple[LeagueConfig, Any], tmp_path: Path) -> Iterator[Registry]:
    registry = simulators.registry(tmp_path / "home", external(case[0]))
    yield registry
    registry.close()


@pytest.mark.usefixtures("ray_session")
def test_trains_publishes_and_evaluates(case: tuple[LeagueConfig, Any], opened: Registry, tmp_path: Path) -> None:
    league = opened.leagues.get(LEAGUE).config
    with simulating(opened, pettingzoo(case[1])):
        algorithm = build_algorithm(league, interface(league), storage=opened.storage)
        try:
            algorithm.train()
            algorithm.save_to_path(str(tmp_path / "64"))
        finally:
            algorithm.stop()
    version = publish(
        Checkpoint(tmp_path / "64", source="run/64", steps=64),
        registry=opened,
        config=league,
        interface=interface(league),
        parent=None,
        git_commit=None,
    )
    assert all(policy.parity.mismatches == 0 for policy in version.manifest.policies.values())
    with simulating(opened, pettingzoo(case[1])):
        report = tournament.evaluate(LEAGUE, registry=opened, blocks=1)
    assert {standing.ref for standing in report.leaderboard} >= {version.ref, "script:random"}


@pytest.mark.parametrize(
    ("training", "named"),
    [
        ({"curriculum": [{"kwargs": {"n": 1}, "until": {"return": 1}}, {"kwargs": {"n": 2}}]}, "training.curriculum"),
        ({"wrappers": ["my.module:wrapper"]}, "training.wrappers"),
    ],
)
def test_what_needs_a_game_in_python_is_refused(training: dict[str, Any], named: str) -> None:
    stock = LeagueConfig.from_mapping({"league": "s", "environment": {"entry_point": "pettingzoo.classic.rps_v2"}})
    with pytest.raises(ConfigError, match=f"{named} is for games in Python"):
        external(stock, training=training)
