from pathlib import Path
from typing import Any

import pytest

from league.config.league import LeagueConfig
from league.config.ppo import PPOConfig
from league.errors import AlreadyRunning, ConfigError, NotFound
from league.settings import Storage
from tests.support.leagues.training_leagues import tictactoe
from training.algorithms.resources import Resources
from training.sweeps.search_space import Settings, TrialOutcome
from training.sweeps.sweep_directory import SweepDirectory

TRIALS: list[Settings] = [{"lr": 0.1}, {"lr": 0.2}]
USED = Resources(runners=0, num_envs=8, threads=3, gpus=0.0)
OUTCOME = TrialOutcome(score=0.5, steps=256, seconds=1.5, ended_early=True)


def league(**settings: Any) -> LeagueConfig:
    document = tictactoe().model_dump(by_alias=True)
    return LeagueConfig.from_mapping(document | {"sweep": {"parameters": {"lr": [0.1, 0.2]}, **settings}})


@pytest.fixture
def storage(tmp_path: Path) -> Storage:
    return Storage.at(tmp_path / "home")


@pytest.fixture
def sweep(storage: Storage) -> SweepDirectory:
    return SweepDirectory.begin(storage, league(), {}, TRIALS, git_commit=None)


def test_an_interrupted_sweep_is_resumed_with_its_outcomes(storage: Storage, sweep: SweepDirectory) -> None:
    sweep.trial(0).mkdir()
    sweep.set_outcome(0, OUTCOME)
    resumed = SweepDirectory.resume(storage, league())
    assert (resumed.path, resumed.record) == (sweep.path, sweep.record)
    assert [resumed.outcome(number) for number in (0, 1)] == [OUTCOME, None]
    assert [resumed.league(number).training.lr for number in (0, 1)] == [0.1, 0.2]


def test_the_references_of_trials_are_pinned(storage: Storage) -> None:
    trials: list[Settings] = [{"opponents": [{"ref": ref, "share": 0.5}]} for ref in ("@champion", "script:random")]
    trials += [{"teacher": {"ref": "@champion", "weight": 0.5}}]
    pins = {"@champion": "tictactoe@1", "script:random": "script:random"}
    sweep = SweepDirectory.begin(storage, league(), pins, trials, None)
    found = [sweep.league(number).training for number in range(3)]
    assert [each.ref for settings in found for each in settings.opponents.fixed] == ["tictactoe@1", "script:random"]
    assert isinstance(found[2], PPOConfig)
    assert found[2].teacher is not None
    assert found[2].teacher.ref == "tictactoe@1"


def test_late_trials_are_recorded_with_their_resources_and_pins(storage: Storage) -> None:
    config = league(search="optuna", samples=3)
    sweep = SweepDirectory.begin(storage, config, {"@champion": "tictactoe@1"}, TRIALS[:1], None, (), [USED])
    settings = {"opponents": [{"ref": "@champion", "share": 0.5}, {"ref": "@other", "share": 0.5}]}
    sweep.add(settings, USED, {"@champion": "tictactoe@2", "@other": "tictactoe@2"})
    resumed = SweepDirectory.resume(storage, config)
    assert (resumed.record, resumed.size) == (sweep.record, 3)
    training = resumed.league(1).training
    assert [opponent.ref for opponent in training.opponents.fixed] == ["tictactoe@1", "tictactoe@2"]
    assert training.threads == USED.threads


def test_a_trial_continues_from_the_checkpoint_with_the_most_steps(sweep: SweepDirectory) -> None:
    assert sweep.checkpoint(0) is None
    for name in ("512", "1024", "2048.part"):
        (sweep.trial(0) / "checkpoints" / name).mkdir(parents=True)
    assert sweep.checkpoint(0) == sweep.trial(0) / "checkpoints" / "1024"


def test_a_complete_sweep_keeps_no_checkpoints_and_is_not_resumed(storage: Storage, sweep: SweepDirectory) -> None:
    (sweep.trial(1) / "checkpoints" / "512").mkdir(parents=True)
    sweep.complete()
    assert not list(sweep.path.rglob("checkpoints"))
    with pytest.raises(NotFound, match=f"sweep {sweep.path.name} is complete"):
        SweepDirectory.resume(storage, league())


def test_a_league_without_sweeps_has_nothing_to_resume(storage: Storage) -> None:
    with pytest.raises(NotFound, match="league tictactoe has no sweep"):
        SweepDirectory.resume(storage, league())


def test_a_changed_league_or_plan_is_not_resumed(storage: Storage, sweep: SweepDirectory) -> None:
    with pytest.raises(ConfigError, match=f"training.* has changed since sweep {sweep.path.name} began"):
        SweepDirectory.resume(storage, league().with_training(lr=0.3))
    with pytest.raises(ConfigError, match=f"^sweep has changed since sweep {sweep.path.name} began"):
        SweepDirectory.resume(storage, league(parameters={"lr": [0.1]}))
    with pytest.raises(ConfigError, match=f"^sweep has changed since sweep {sweep.path.name} began"):
        SweepDirectory.resume(storage, league(search="optuna"))


def test_a_sweep_has_one_driver(storage: Storage, sweep: SweepDirectory) -> None:
    with (
        sweep.locked(),
        pytest.raises(AlreadyRunning, match=sweep.path.name),
        SweepDirectory.resume(storage, league()).locked(),
    ):
        pass
    with sweep.locked():
        pass
