"""Leagues whose games run in simulators train, publish and evaluate like others."""

import importlib
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from pettingzoo.classic import tictactoe_v3

from evaluation.matches import tournament
from league.config.league import LeagueConfig
from league.environments.building import interface
from league.errors import ConfigError, LeagueError
from league.registry.registry import Registry
from policy_league_client.simulator import PettingZooGame, Report
from tests.support import simulators
from tests.support.algorithms import running
from tests.support.leagues.training_leagues import small
from tests.support.simulators import LEAGUE, external, pettingzoo, simulating
from tests.support.waiting import until
from training.algorithms import off_policy
from training.export import parity
from training.export.publish import Checkpoint, publish
from training.runs.trial import FROM_SCRATCH, Trial, TrialPlan

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


class Dying(PettingZooGame):
    """Tic-tac-toe of a simulator that dies before its next action."""

    remaining = 0

    def step(self, actions: Mapping[str, Any]) -> list[Report]:
        if not type(self).remaining:
            raise LeagueError("the simulator dies")
        type(self).remaining -= 1
        return super().step(actions)


@pytest.mark.slow
@pytest.mark.usefixtures("ray_session")
@pytest.mark.parametrize(
    "training",
    [
        pytest.param(ON_POLICY | {"runners": 1}, id="runner"),
        pytest.param(ON_POLICY, id="ppo"),
        pytest.param({"algorithm": "dqn"} | OFF_POLICY, id="dqn"),
    ],
)
def test_a_run_ends_although_its_last_simulator_left_within_an_update(training: dict[str, Any], tmp_path: Path) -> None:
    stock = {"entry_point": "pettingzoo.classic.tictactoe_v3"}
    config = external(LeagueConfig.from_mapping({"league": "stock", "environment": stock, "training": training}))
    opened = simulators.registry(tmp_path, config)
    plan = TrialPlan(FROM_SCRATCH, tmp_path / "checkpoints", tmp_path / "stop", opened.storage)
    plan.checkpoints.mkdir()
    document = {"league": config.model_dump(by_alias=True), "interface": interface(config).model_dump(), "plan": plan}
    trial = Trial(document)
    Dying.remaining = 1500
    with simulating(opened, lambda: Dying(tictactoe_v3.raw_env())):
        until(lambda: trial.train()["steps"] and not Dying.remaining)
    assert not trial.train()["done"], "it waits for another simulator"
    plan.stop_file.touch()
    result = trial.train()
    assert (result["done"], Path(result["checkpoint"]).name) == (True, str(result["steps"]))
    trial.cleanup()
    opened.close()


def test_what_needs_a_game_in_python_is_refused() -> None:
    stock = small("pettingzoo.classic.rps_v2")
    stages = [{"kwargs": {"n": 1}, "until": {"return": 1}}, {"kwargs": {"n": 2}}]
    with pytest.raises(ConfigError, match=r"training\.curriculum is for games in Python"):
        external(stock, training={"curriculum": stages})
    with pytest.raises(ConfigError, match=r"training\.wrappers is for games in Python"):
        external(stock, training={"wrappers": ["my.module:wrapper"]})
