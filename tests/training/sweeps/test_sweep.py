"""Complete sweeps: Ray Tune with several trials, publishing of the best one, interruption."""

import io
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from rich.console import Console
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from evaluation.service.strength_process import StrengthProcess
from league.config.league import LeagueConfig
from league.errors import ConfigError, NotFound
from league.registry.registry import Registry
from league.settings import Storage
from tests.support.leagues.training_leagues import tictactoe
from tests.support.waiting import until
from training.runs.train import train
from training.sweeps.sweep import sweep

SETTINGS = {"steps": 2048, "train_batch_size": 256, "minibatch_size": 128, "epochs": 2, "checkpoint_every": 256}
DEADLINE = 240


def league(parameters: dict[str, Any], training: dict[str, Any] | None = None, **settings: Any) -> LeagueConfig:
    document = tictactoe(**SETTINGS | (training or {})).model_dump(by_alias=True)
    return LeagueConfig.from_mapping(document | {"sweep": {"parameters": parameters, **settings}})


@pytest.fixture
def registry(tmp_path: Path) -> Iterator[Registry]:
    registry = Registry.open(Storage.at(tmp_path / "home"))
    yield registry
    registry.close()


def test_invalid_sweeps_are_rejected_before_training(registry: Registry) -> None:
    rejected = {
        "sweep is missing": tictactoe(),
        "did you mean 'lr'": league({"lrr": [1]}),
        r"lr -1: .*training\.lr": league({"lr": [0.1, -1]}),
        r"per_policy\.nobody: unknown policy; the league has shared": league({"per_policy.nobody.lr": [1]}),
        r"sweep\.metric: unknown metric 'retrun'; expected one of .*shared/return": league(
            {"lr": [1]}, metric="retrun"
        ),
        r"sweep\.asha\.grace_steps": league({"lr": [1]}, metric="return", asha={"grace_steps": 10**6}),
        r"sweep\.metric: strength is measured by games, for which": league({"lr": [1]}),
    }
    imitation = {"algorithm": "marwil", "data": str(registry.storage.home), "epochs": 1, "strength": None}
    imitating(registry.storage.home)
    rejected |= {
        r"search\.simulations 4: .*training\.search: unknown key": league({"search.simulations": [4]}),
        r"sweep\.metric: unknown metric 'return'; expected one of shared/": league(
            {"lr": [1]}, training=imitation, metric="return"
        ),
    }
    for words, config in rejected.items():
        with pytest.raises(ConfigError, match=words):
            sweep(config, registry=registry)
    config = league({"lr": [1]}, training={"strength": None})
    with pytest.raises(ConfigError, match=r"training\.strength, which is null"):
        sweep(config, registry=registry, open_games=StrengthProcess)
    assert not (registry.storage.home / "sweeps").exists()


@pytest.mark.slow
@pytest.mark.usefixtures("ray_session")
def test_bad_trials_stop_early_and_the_best_is_published(registry: Registry) -> None:
    """The metric is the entropy, so that a trial that learns quickly is the worse one."""
    parameters = {"lr": [1e-5, 0.05], "per_policy.shared.entropy": [0.0]}
    asha = {"grace_steps": 512, "reduction_factor": 2}
    config, output = league(parameters, metric="shared/entropy", asha=asha), io.StringIO()
    report = sweep(config, registry=registry, console=Console(file=output))
    good, bad = report.trials
    assert report.is_whole
    assert report.best == good
    assert good.outcome is not None
    assert bad.outcome is not None
    assert (good.outcome.steps, good.outcome.ended_early) == (2048, False)
    assert bad.outcome.ended_early
    assert bad.outcome.steps < 2048
    assert good.score is not None
    assert bad.score is not None
    assert good.score > bad.score
    assert "1 of 2: trial 0 (lr 1e-05, per_policy.shared.entropy 0.0): +1." in output.getvalue()
    assert "ended early" in output.getvalue().splitlines()[-1]

    assert report.version is not None
    (version,) = registry.versions.all("tictactoe")
    assert version.ref == report.version.ref
    assert version.source == f"sweep-{report.path.name}/trial-000/2048"
    settings = version.manifest.settings
    assert (settings["lr"], settings["per_policy"]["shared"]["entropy"]) == (1e-5, 0.0)
    assert not list(report.path.rglob("checkpoints"))
    for number in (0, 1):
        events = EventAccumulator(str(report.path / f"trial-00{number}"))
        assert "shared/entropy" in events.Reload().Tags()["scalars"]
    with pytest.raises(NotFound, match="complete"):
        sweep(config, registry=registry, resume=True)


@pytest.mark.slow
@pytest.mark.usefixtures("ray_session")
def test_trials_of_rivals_are_compared_by_strength(registry: Registry) -> None:
    """The first trial learns nothing, so that it plays as at random. Both play the champion and the anchor."""
    settings = {"steps": 8192, "checkpoint_every": 4096, "strength": {"games": 100}}
    output = io.StringIO()
    champion = untrained_champion(registry)
    config = league({"lr": [1e-9, 0.01]}, training=settings)
    report = sweep(config, registry=registry, console=Console(file=output, width=500), open_games=StrengthProcess)
    assert f"Strength: mean score against {champion}, script:random." in output.getvalue()
    assert report.best == report.trials[1]
    for trial in report.trials:
        assert trial.outcome is not None
        assert trial.outcome.score is not None
        assert trial.outcome.low is not None
        assert trial.outcome.high is not None
        assert trial.outcome.low < trial.outcome.score < trial.outcome.high
        events = EventAccumulator(str(report.path / f"trial-00{trial.number}"))
        scalars = events.Reload().Tags()["scalars"]
        assert {"run/strength", "strength/low", "strength/high", "strength/script_random"} <= set(scalars)
    assert "% [" in output.getvalue()


def untrained_champion(registry: Registry) -> str:
    """Train a champion for one update, in which it learns nothing. Returns its reference."""
    settings = SETTINGS | {"steps": 256, "lr": 1e-9}
    (version,) = train(tictactoe(**settings), registry=registry, console=Console(quiet=True))
    registry.aliases.set("tictactoe", "champion", version.number, expected=None, actor="test", reason="first")
    return version.ref


def imitating(directory: Path) -> dict[str, Any]:
    """Settings for learning from a recorded game of one move."""
    row = {"match": "1", "game": 0, "agent": "player_1", "step": 0, "action": 4, "reward": 1.0, "terminated": True}
    row |= {"observation": [0] * 18, "action_mask": [1] * 9}
    pq.write_table(pa.Table.from_pylist([row]), directory / "shared.parquet")
    return {"algorithm": "marwil", "data": str(directory)}


SEPARATE = {"algorithm": "policy_league.examples.extending.separate_critic:SeparatePPO"}
SAC = {"algorithm": "policy_league.examples.extending.sac:SAC", "learning_starts": 64, "batch_size": 32}
RESIDUAL = {"entry_point": "policy_league.examples.extending.residual:Residual", "kwargs": {"blocks": 1, "channels": 2}}


@pytest.mark.slow
@pytest.mark.usefixtures("ray_session")
@pytest.mark.parametrize(
    ("training", "parameters"),
    [
        ({"network": RESIDUAL}, {"network.kwargs.channels": [2, 4]}),
        (SEPARATE, {"lr": [0.001, 0.01]}),
        (SAC, {"temperature": [0.01, 0.1]}),
        ({}, {"critic": ["own", "central"], "normalize_values": [True]}),
        (imitating, {"beta": [0.0, 1.0]}),
    ],
    ids=["network", "PPO of one's own", "off-policy of one's own", "MAPPO", "MARWIL"],
)
def test_what_extends_training_is_swept(training: Any, parameters: dict[str, Any], registry: Registry) -> None:
    training = imitating(registry.storage.home) if callable(training) else training
    on_policy = {"train_batch_size": 64, "minibatch_size": 64} if training is not SAC else {}
    settings = {"runners": 0, "num_envs": 4, "steps": 256, "strength": {"games": 4}} | on_policy | training
    document: dict[str, Any] = {"environment": {"entry_point": "pettingzoo.classic.tictactoe_v3"}, "league": "swept"}
    document |= {"training": settings, "sweep": {"parameters": parameters}}
    config = LeagueConfig.from_mapping(document)
    report = sweep(config, registry=registry, console=Console(quiet=True), open_games=StrengthProcess)
    assert [trial.error for trial in report.trials] == [None, None]
    assert all(trial.score is not None for trial in report.trials)
    assert report.version is not None


SCRIPT = """
import sys
from league.registry.registry import Registry
from league.settings import Storage
from tests.training.sweeps.test_sweep import LONG
from training.sweeps.sweep import sweep
sweep(LONG, registry=Registry.open(Storage.at(sys.argv[1])))
"""
LONG = league({"steps": [256, 1024]}, training={"epochs": 32, "minibatch_size": 32}, metric="shared/length")


@pytest.mark.slow
@pytest.mark.usefixtures("ray_session")
def test_a_killed_sweep_continues_with_its_unfinished_trials(registry: Registry) -> None:
    """The driver is killed with SIGKILL in the second trial, after the end of the first."""
    home = registry.storage.home
    driver = subprocess.Popen([sys.executable, "-c", SCRIPT, str(home)], stdout=subprocess.DEVNULL)
    try:
        _wait_for(home, "sweeps/tictactoe/*/trial-001/checkpoints/256")
    finally:
        os.kill(driver.pid, signal.SIGKILL)
        driver.wait()
    (outcome,) = home.rglob("outcome.json")
    before = outcome.stat().st_mtime_ns
    shorter = league({"steps": [256]}, training={"epochs": 32, "minibatch_size": 32}, metric="shared/length")
    with pytest.raises(ConfigError, match="sweep has changed"):
        sweep(shorter, registry=registry, resume=True)
    output = io.StringIO()
    report = sweep(LONG, registry=registry, resume=True, publish_best=False, console=Console(file=output))
    assert outcome.stat().st_mtime_ns == before, "a finished trial is not repeated"
    assert "trial 0" not in output.getvalue()
    assert [trial.outcome.steps for trial in report.trials if trial.outcome] == [256, 1024]
    assert report.version is None
    first_of_second_life = EventAccumulator(str(max((report.path / "trial-001").glob("events*"))))
    assert first_of_second_life.Reload().Scalars("run/steps")[0].step > 256, "the trial continues from its checkpoint"


SEARCH = league(
    {"lr": {"loguniform": [1e-5, 1e-2]}, "minibatch_size": [32, 10_000], "hidden": [[16], [8, 8]]},
    training={"steps": 768, "epochs": 8},
    metric="shared/entropy",
    search="optuna",
    samples=4,
)
"""A minibatch of 10,000 is larger than a batch: such proposals are not tried."""


@pytest.mark.slow
@pytest.mark.usefixtures("ray_session")
def test_a_killed_search_by_optuna_continues_as_the_same_search(registry: Registry, tmp_path: Path) -> None:
    """The driver is killed with SIGKILL in the second trial. Its settings stay, and later ones follow from results."""
    pytest.importorskip("optuna")
    home = registry.storage.home
    driver = subprocess.Popen(
        [sys.executable, "-c", SCRIPT.replace("LONG", "SEARCH"), str(home)], stdout=subprocess.DEVNULL
    )
    try:
        _wait_for(home, "sweeps/tictactoe/*/trial-001/checkpoints/[1-9]*")
    finally:
        os.kill(driver.pid, signal.SIGKILL)
        driver.wait()
    (file,) = home.rglob("sweep.json")
    before = json.loads(file.read_text())["trials"]
    assert len(before) < 4, "a trial is recorded when it starts"
    output = io.StringIO()
    report = sweep(SEARCH, registry=registry, resume=True, console=Console(file=output, width=500))
    assert report.is_whole
    assert [trial.outcome.steps for trial in report.trials if trial.outcome] == [768] * 4
    trials = [trial.settings for trial in report.trials]
    assert trials[: len(before)] == before
    assert "Not tried: sweep.parameters: lr" in output.getvalue()
    assert {settings["minibatch_size"] for settings in trials} == {32}
    with closing(Registry.open(Storage.at(tmp_path / "whole"))) as whole:
        uninterrupted = sweep(SEARCH, registry=whole, console=Console(quiet=True))
    assert [trial.settings for trial in uninterrupted.trials] == trials
    assert report.best is not None
    assert report.version is not None
    assert report.version.manifest.settings["lr"] == report.best.settings["lr"]


def _wait_for(home: Path, pattern: str) -> None:
    until(lambda: any(home.glob(pattern)), DEADLINE)
