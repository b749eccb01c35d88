"""What a sweep keeps, and the strength of its trials: the mean of their scores, and its interval."""

import json
import math
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from evaluation.matches.worker import MatchWorker
from evaluation.service.strength_process import StrengthProcess
from evaluation.service.strength_worker import measured
from league.config.league import LeagueConfig
from league.config.ppo import PPOConfig
from league.environments.building import interface
from league.errors import AlreadyRunning, ConfigError, NotFound
from league.registry.registry import Registry
from league.registry.training.strength import StrengthScore
from league.settings import Storage
from tests.support.algorithms import running
from tests.support.leagues.training_leagues import tictactoe
from training.algorithms.resources import Resources
from training.export import parity
from training.sweeps.search_space import Settings, TrialOutcome
from training.sweeps.strength import HIGH, LOW, STRENGTH, mean_strength, trial_strength
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
    settings = [sweep.league(number).training for number in range(3)]
    taught, opponents = settings[2], [opponent.ref for part in settings for opponent in part.opponents.fixed]
    assert opponents == ["tictactoe@1", "script:random"]
    assert isinstance(taught, PPOConfig)
    assert taught.teacher is not None
    assert taught.teacher.ref == "tictactoe@1"


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


def test_a_single_score_keeps_its_interval() -> None:
    assert mean_strength([StrengthScore("script:random", 200, 0.8, 0.7, 0.875)]) == pytest.approx((0.8, 0.7, 0.875))


def test_the_interval_of_a_mean_is_narrower_than_those_of_its_scores() -> None:
    """Of n equal scores it is narrower by √n."""
    scores = [StrengthScore(f"tictactoe@{number}", 200, 0.6, 0.5, 0.7) for number in range(4)]
    assert mean_strength(scores) == pytest.approx((0.6, 0.55, 0.65))


def test_the_distances_to_the_bounds_add_up_in_quadrature() -> None:
    scores = [StrengthScore("a", 100, 0.5, 0.2, 0.9), StrengthScore("b", 100, 1.0, 0.6, 1.0)]
    mean, low, high = mean_strength(scores)
    assert mean == 0.75
    assert low == pytest.approx(0.75 - math.hypot(0.3, 0.4) / 2)
    assert high == pytest.approx(0.75 + 0.4 / 2)


@pytest.mark.usefixtures("ray_session")
def test_a_checkpoint_plays_and_training_continues_as_without_games(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In this process: that another one plays is tested with the evaluation service."""
    monkeypatch.setattr(parity, "EXPORTED", replace(parity.EXPORTED, observations=256))
    config = tictactoe(train_batch_size=64, minibatch_size=32, epochs=1, strength={"games": 20})
    opponents = ["script:random", "script:one_ply"]
    with running(config) as algorithm:
        algorithm.train()
        algorithm.save_to_path(str(tmp_path / "64"))
    with closing(Registry.open(Storage.at(tmp_path / "home"))) as registry:
        registry.leagues.register(config, interface(config))
        state = torch.get_rng_state()
        with closing(StrengthProcess(registry.storage)) as games:
            worker = MatchWorker(config, registry)
            monkeypatch.setattr(
                games._process, "request", lambda text: (measured(registry, worker, json.loads(text)), b"")
            )
            metrics = trial_strength(tmp_path / "64", config, interface(config), opponents, games)
        assert torch.equal(state, torch.get_rng_state())
        assert registry.versions.all("tictactoe") == []
    scores = [metrics[f"{STRENGTH}/{opponent}"] for opponent in opponents]
    assert metrics[STRENGTH] == pytest.approx(sum(scores) / 2)
    assert 0 <= metrics[LOW] < metrics[STRENGTH] < metrics[HIGH] <= 1
