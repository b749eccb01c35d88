"""Leagues whose games run in simulators train, publish and evaluate like others."""

import importlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from evaluation.matches import tournament
from league.config.league import LeagueConfig
from league.environments.building import interface
from league.errors import ConfigError
from league.registry.registry import Registry
from tests.support import simulators
from tests.support.algorithms import running
from tests.support.leagues.training_leagues import small
from tests.support.simulators import LEAGUE, external, pettingzoo, simulating
from training.algorithms import off_policy
from training.export import parity
from training.export.publish import Checkpoint, publish

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
def test_trains_publishes_and_evaluates(
    case: tuple[LeagueConfig, Any], opened: Registry, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(off_policy, "ITERATION_STEPS", 128)
    monkeypatch.setattr(parity, "EXPORTED", replace(parity.EXPORTED, observations=256))
    league = opened.leagues.get(LEAGUE).config
    with simulating(opened, pettingzoo(case[1])), running(league, storage=opened.storage) as algorithm:
        algorithm.train()
        algorithm.save_to_path(str(tmp_path / "64"))
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


def test_what_needs_a_game_in_python_is_refused() -> None:
    stock = small("pettingzoo.classic.rps_v2")
    stages = [{"kwargs": {"n": 1}, "until": {"return": 1}}, {"kwargs": {"n": 2}}]
    with pytest.raises(ConfigError, match=r"training\.curriculum is for games in Python"):
        external(stock, training={"curriculum": stages})
    with pytest.raises(ConfigError, match=r"training\.wrappers is for games in Python"):
        external(stock, training={"wrappers": ["my.module:wrapper"]})
