"""Each environment of PettingZoo 1.27 and mpe2 except Atari, and games of OpenSpiel: one update, a version, its
matches, its actions."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evaluation.matches import tournament
from league.config.league import LeagueConfig
from league.environments.building import interface
from league.environments.conformance import examination
from league.environments.conformance.examination import examine
from league.policies import load
from league.registry.registry import Registry
from league.settings import Storage
from league.spaces.arrays import tensors
from league.spaces.conversion import to_gymnasium
from tests.support.environments.cases import CASES, Case
from training.export.publish import Checkpoint, publish
from training.runs.trial import build_algorithm


@pytest.fixture
def registry(tmp_path: Path) -> Iterator[Registry]:
    registry = Registry.open(Storage.at(tmp_path / "home"))
    yield registry
    registry.close()


QUICK = "simple_speaker_listener_v4"
"""One whose agents differ. Testing all others takes long."""


GAMES = (
    "backgammon",
    "breakthrough",
    "connect_four",
    "goofspiel",
    "hex",
    "kuhn_poker",
    "leduc_poker",
    "liars_dice",
    "matrix_rps",
    "othello",
    "pig",
    "tic_tac_toe",
)
"""Games of OpenSpiel."""


def _cases() -> list[Any]:
    names = {case.entry_point.rpartition(".")[2]: case for case in CASES}
    return [
        pytest.param(case, id=name, marks=[] if name == QUICK else pytest.mark.slow) for name, case in names.items()
    ]


@pytest.mark.parametrize("case", _cases())
@pytest.mark.usefixtures("ray_session", "parsed_operators")
def test_trains_publishes_evaluates_and_loads(case: Case, registry: Registry, tmp_path: Path) -> None:
    _train_publish_evaluate_and_load(case.league(), registry, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("game", GAMES)
@pytest.mark.usefixtures("ray_session", "parsed_operators")
def test_games_of_openspiel_train_publish_and_evaluate(game: str, registry: Registry, tmp_path: Path) -> None:
    pytest.importorskip("pyspiel")
    league = Case("openspiel", {"game": game}).league()
    _train_publish_evaluate_and_load(league, registry, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("entry_point", [case.entry_point for case in CASES])
@pytest.mark.usefixtures("ray_session")
def test_an_entry_point_alone_is_enough(entry_point: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(examination, "COMPARED_STEPS", 500)  # other tests compare thousands
    monkeypatch.setattr(examination, "MEASURED_SECONDS", 0.01)
    alone = LeagueConfig.from_mapping({"league": "alone", "environment": {"entry_point": entry_point}})
    assert examine(alone, episodes=1, steps=50).passed
    short = alone.with_training(runners=0, num_envs=1, train_batch_size=32, minibatch_size=32, epochs=1, hidden=(8,))
    algorithm = build_algorithm(short, interface(short))
    try:
        algorithm.train()
    finally:
        algorithm.stop()


def _train_publish_evaluate_and_load(league: LeagueConfig, registry: Registry, tmp_path: Path) -> None:
    league_interface = interface(league)
    registry.leagues.register(league, league_interface)
    algorithm = build_algorithm(league, league_interface)
    try:
        algorithm.train()
        algorithm.save_to_path(str(tmp_path / "64"))
    finally:
        algorithm.stop()

    version = publish(
        Checkpoint(tmp_path / "64", source="run/64", steps=64),
        registry=registry,
        config=league,
        interface=league_interface,
        parent=None,
        git_commit=None,
    )
    assert all(policy.parity.mismatches == 0 for policy in version.manifest.policies.values())

    report = tournament.evaluate(league.league, registry=registry, blocks=1)
    assert {standing.ref for standing in report.leaderboard} >= {version.ref, "script:random"}

    for policy in league_interface.policy_ids:
        spaces = league_interface.of_policy(policy)
        observation = to_gymnasium(spaces.observation)
        observation.seed(3)
        arrays = tensors(spaces.observation, observation.sample())
        batch = {name: array[np.newaxis] for name, array in arrays.items()}
        if "action_mask" in batch:
            batch["action_mask"] = np.ones_like(batch["action_mask"])
        loaded = load(version.ref, policy, registry)
        assert to_gymnasium(spaces.action).contains(loaded.act(batch).actions[0])
