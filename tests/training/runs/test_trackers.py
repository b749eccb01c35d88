"""Runs in experiment trackers: MLflow in its file store, Weights & Biases and Comet offline, Aim in a folder."""

import io
import sys
import threading
import zipfile
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from league.errors import ConfigError
from league.registry.registry import Registry
from league.registry.storage.rows import RunState, StrengthRow, VersionRow
from tests.support.leagues.registries import interface, publish
from tests.support.leagues.training_leagues import tictactoe
from training.runs import trackers as module
from training.runs.run_directory import RunDirectory
from training.runs.trackers import Trackers, check_trackers
from training.runs.train import check, train

RESULT = {"timesteps_total": 512, "steps": 256, "return": 0.5, "shared/kl": 0.25, "opponents/tictactoe@1/score": 0.75}
SCORES: dict[str, Any] = {"score": 0.6, "low": 0.5, "high": 0.7}
REPORTED = ("shared/kl", "strength/script:random/score", "manifest.json")
RESULT |= {"done": False, "checkpoint": "/checkpoint", "seconds": 1.5}


def run(registry: Registry, *names: str) -> RunDirectory:
    return RunDirectory.begin(registry.storage, tictactoe(trackers=names), None, None)


def measure(version: VersionRow, games: int) -> list[StrengthRow]:
    identity: dict[str, Any] = {
        "league": version.league,
        "version": version.number,
        "run": version.run,
        "opponent": "script:random",
    }
    return [StrengthRow(**identity, **SCORES, steps=512, games=games, at=datetime.now(UTC))]


def report_all(registry: Registry, directory: RunDirectory) -> str:
    """Report curves, a version and its strength; return the messages."""
    messages = io.StringIO()
    version = publish(registry, f"{directory.id}/512")
    with Trackers(directory, registry, Console(file=messages, width=300).print) as trackers:
        trackers.report(RESULT)
        trackers.published(version)
        measuring = trackers.measuring(measure)
        assert measuring is not None
        assert measuring(version, games=2)[0].score == 0.6
    return messages.getvalue()


class Recorder:
    """A tracker that keeps what it receives. It is down while `is_down` is set."""

    def __init__(self, directory: RunDirectory) -> None:
        self.reports: list[Any] = []

    def log(self, values: Mapping[str, float], step: int) -> None:
        self.reports.append((dict(values), step))

    def add(self, ref: str, files: Path, about: Mapping[str, Any]) -> None:
        self.reports.append((ref, sorted(path.name for path in files.iterdir()), dict(about)))

    def end(self, state: RunState) -> None:
        self.reports.append(state)


def test_curves_versions_and_strength_are_reported_in_order(
    registry: Registry, monkeypatch: pytest.MonkeyPatch
) -> None:
    directory = run(registry, "mlflow")
    recorder = Recorder(directory)
    monkeypatch.setattr(module, "OPEN", {"mlflow": lambda _: recorder})
    assert report_all(registry, directory) == ""
    curves, version, strength, end = recorder.reports
    values = {"run/return": 0.5, "shared/kl": 0.25, "opponents/tictactoe@1/score": 0.75}
    assert curves == (curves[0] | values, 512)
    assert {"run/done", "run/checkpoint", "run/timesteps_total"} & curves[0].keys() == set()
    ref, files, about = version
    assert (ref, about["run"], about["version"]) == ("tictactoe@1", directory.id, "tictactoe@1")
    assert "manifest.json" in files
    assert "training" not in files
    assert strength == ({f"strength/script:random/{name}": value for name, value in SCORES.items()}, 512)
    assert end == "ended"


def test_training_continues_without_a_tracker_that_is_down(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is opened again with the next report."""
    directory, recorder, attempts = run(registry, "mlflow", "wandb"), Recorder(run(registry)), []

    def fail_twice(_: RunDirectory) -> Recorder:
        attempts.append(None)
        if len(attempts) <= 2:
            raise ConnectionError("refused\nat line 2")
        return recorder

    other = Recorder(directory)
    monkeypatch.setattr(module, "OPEN", {"mlflow": fail_twice, "wandb": lambda _: other})
    messages = report_all(registry, directory)
    assert messages.count("Cannot report to mlflow; training continues: ConnectionError: refused") == 1
    assert "wandb" not in messages
    assert [type(report) for report in recorder.reports] == [tuple, str]
    assert len(other.reports) == 4


def test_a_run_ends_although_a_tracker_does_not_answer(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    answer = threading.Event()
    monkeypatch.setattr(module, "OPEN", {"mlflow": lambda _: answer.wait()})
    monkeypatch.setattr(module, "LAST_SECONDS", 0.01)
    messages = report_all(registry, run(registry, "mlflow"))
    answer.set()
    assert "Cannot report to mlflow; training continues: no answer within 0.01 s" in messages


def test_a_missing_package_is_named_before_anything_starts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "comet_ml", None)
    with pytest.raises(ConfigError, match=r"training\.trackers: comet .*: pip install 'policy-league\[comet\]'"):
        check(tictactoe(trackers=["comet"]), interface())
    check_trackers(())


def test_invalid_trackers_are_rejected() -> None:
    with pytest.raises(ConfigError, match=r"training.*trackers.*wandb, mlflow, comet, aim or package.module:Class"):
        tictactoe(trackers=["tensorboard"])
    with pytest.raises(ConfigError, match=r"training.*trackers.*each tracker once, got mlflow"):
        tictactoe(trackers=["mlflow", "mlflow"])


def test_a_run_in_mlflow_has_settings_curves_and_versions(
    registry: Registry, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A resumed run continues with the same run of MLflow."""
    mlflow = pytest.importorskip("mlflow", reason="pip install mlflow-skinny")
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"file:{tmp_path / 'mlruns'}")
    monkeypatch.setenv("MLFLOW_ALLOW_FILE_STORE", "true")
    monkeypatch.setenv("LEAGUE_URL", "http://league/")
    directory = run(registry, "mlflow")
    assert report_all(registry, directory) == ""
    assert report_all(registry, directory) == ""
    client = mlflow.MlflowClient()
    (tracked,) = client.search_runs([client.get_experiment_by_name("tictactoe").experiment_id])
    assert (tracked.info.run_name, tracked.info.status) == (directory.id, "FINISHED")
    assert tracked.data.params["training.lr"] == str(directory.record.config.training.lr)
    assert tracked.data.params["url"] == f"http://league/leagues/tictactoe/runs/{directory.id}"
    assert tracked.data.metrics["shared/kl"] == 0.25
    assert tracked.data.metrics["strength/script-random/score"] == 0.6
    points = client.get_metric_history(tracked.info.run_id, "opponents/tictactoe-1/score")
    assert [(point.value, point.step) for point in points] == [(0.75, 512)] * 2
    names = {item.path for item in client.list_artifacts(tracked.info.run_id, "tictactoe-1")}
    assert {"tictactoe-1/manifest.json", "tictactoe-1/version.json"} <= names


@pytest.mark.slow
@pytest.mark.usefixtures("ray_session")
def test_a_training_run_reports_its_versions(
    registry: Registry, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """W&B is down."""
    mlflow = pytest.importorskip("mlflow", reason="pip install mlflow-skinny")
    pytest.importorskip("wandb", reason="pip install wandb")

    def fail(_: RunDirectory) -> Recorder:
        raise ConnectionError("refused")

    monkeypatch.setitem(module.OPEN, "wandb", fail)
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"file:{tmp_path / 'mlruns'}")
    monkeypatch.setenv("MLFLOW_ALLOW_FILE_STORE", "true")
    settings = {"steps": 512, "train_batch_size": 256, "minibatch_size": 128, "checkpoint_every": 256}
    messages = io.StringIO()
    config = tictactoe(**settings, trackers=["mlflow", "wandb"])
    versions = train(config, registry=registry, console=Console(file=messages, width=300))
    assert messages.getvalue().count("Cannot report to wandb; training continues: ") == 1
    client = mlflow.MlflowClient()
    (tracked,) = client.search_runs([client.get_experiment_by_name("tictactoe").experiment_id])
    assert tracked.info.run_name == versions[0].run
    assert max(point.step for point in client.get_metric_history(tracked.info.run_id, "shared/kl")) == 512
    folders = {item.path for item in client.list_artifacts(tracked.info.run_id)}
    assert folders == {version.ref.replace("@", "-") for version in versions}


def test_a_run_in_wandb_is_written_offline(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("wandb", reason="pip install wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    directory = run(registry, "wandb")
    assert report_all(registry, directory) == ""
    (file,) = directory.path.glob("wandb/offline-run-*/*.wandb")
    content = file.read_bytes()
    assert all(text.encode() in content for text in (directory.id, *REPORTED, "tictactoe@1"))


def test_a_run_in_comet_is_written_offline(registry: Registry, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("comet_ml", reason="pip install comet-ml")
    monkeypatch.setenv("COMET_START_ONLINE", "0")
    monkeypatch.setenv("COMET_OFFLINE_DIRECTORY", str(tmp_path / "comet"))
    directory = run(registry, "comet")
    assert report_all(registry, directory) == ""
    (archive,) = (tmp_path / "comet").glob("*.zip")
    with zipfile.ZipFile(archive) as files:
        content = files.read("messages.json").decode()
    assert all(text in content for text in (directory.id, *REPORTED, "training.lr"))


def test_a_run_in_aim_has_settings_curves_and_links(
    registry: Registry, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    aim = pytest.importorskip("aim", reason="pip install aim")
    monkeypatch.chdir(tmp_path)
    directory = run(registry, "aim")
    assert report_all(registry, directory) == ""
    tracked = aim.Run((directory.path / "aim.id").read_text(), capture_terminal_logs=False)
    assert tracked["settings"]["run"] == directory.id
    assert tracked.name == directory.id
    assert tracked.experiment == "tictactoe"
    assert tracked["versions"]["tictactoe@1"]["steps"] >= 0
    assert {(metric.name, metric.context["group"]) for metric in tracked.metrics()} >= {("kl", "shared")}
