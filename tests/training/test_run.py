"""Whole runs: Ray Tune, RLlib's Algorithm with a remote runner, publishing, interruption."""

import io
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from rich.console import Console
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from league.errors import ConfigError, NotFound, ParityError, UnknownVersion
from league.refs import CheckpointRef
from league.registry.registry import Registry
from league.registry.rows import VersionRow
from league.settings import Storage
from tests.training.leagues import tictactoe
from training import publish as publishing
from training.run import train

SETTINGS = {"runners": 1, "train_batch_size": 256, "minibatch_size": 128, "epochs": 1, "checkpoint_every": 512}
LEAGUE = tictactoe(steps=1024, **SETTINGS)
DEADLINE = 120


@pytest.fixture
def registry(tmp_path: Path) -> Iterator[Registry]:
    registry = Registry.open(Storage.at(tmp_path / "home"))
    yield registry
    registry.close()


def lineage(versions: list[VersionRow]) -> list[tuple[int, int, int | None]]:
    return [(version.number, version.steps, version.parent) for version in versions]


def curves(run: Path) -> EventAccumulator:
    events = EventAccumulator(str(run / "life-1"))
    events.Reload()
    return events


@pytest.mark.usefixtures("ray_session")
def test_a_run_publishes_its_checkpoints_and_further_training_names_its_parent(registry: Registry) -> None:
    shown, interrupt = io.StringIO(), signal.getsignal(signal.SIGINT)
    versions = train(LEAGUE, registry=registry, console=Console(file=shown))
    assert signal.getsignal(signal.SIGINT) is interrupt, "Ctrl-C after training is not Tune's"
    assert lineage(versions) == [(1, 512, None), (2, 1024, 1)]
    assert "Published tictactoe@1 after 512 steps" in shown.getvalue()
    assert "shared: return" in shown.getvalue()
    (run,) = (registry.storage.home / "runs" / "tictactoe").iterdir()
    assert not list(run.rglob("checkpoints/*")), "a published checkpoint is in the version alone"
    tags = curves(run).Tags()["scalars"]
    assert {"ray/tune/shared/return", "ray/tune/shared/length", "ray/tune/shared/entropy"} <= set(tags)
    assert curves(run).Scalars("ray/tune/shared/entropy")[-1].step == 1024
    with pytest.raises(NotFound, match="complete"):
        train(LEAGUE, registry=registry, resume=True)

    further = train(LEAGUE, registry=registry, parent=CheckpointRef("tictactoe", 1))
    assert lineage(further) == [(3, 1024, 1), (4, 1536, 3)]


def test_what_cannot_be_trained_is_refused_before_anything_starts(registry: Registry) -> None:
    with pytest.raises(ConfigError, match="either --from or --resume"):
        train(LEAGUE, registry=registry, parent=CheckpointRef("tictactoe", 1), resume=True)
    with pytest.raises(ConfigError, match="of another league"):
        train(LEAGUE, registry=registry, parent=CheckpointRef("chess", 1))
    with pytest.raises(UnknownVersion):
        train(LEAGUE, registry=registry, parent=CheckpointRef("tictactoe", 1))
    with pytest.raises(ConfigError, match="kernel of 4"):
        train(tictactoe(convolutions=[{"filters": 4, "kernel": 4}]), registry=registry)
    assert not (registry.storage.home / "runs").exists()


@pytest.mark.usefixtures("ray_session")
def test_a_failing_proof_ends_the_run_and_the_versions_before_stay(
    registry: Registry, monkeypatch: pytest.MonkeyPatch
) -> None:
    prove, proofs = publishing.parity.prove, iter([True, False, False])

    def once(*arguments: object) -> object:
        if not next(proofs):
            raise ParityError("the graph differs")
        return prove(*arguments)

    monkeypatch.setattr(publishing.parity, "prove", once)
    with pytest.raises(ParityError, match="the graph differs"):
        train(tictactoe(steps=4096, **SETTINGS), registry=registry)
    assert lineage(registry.versions("tictactoe")) == [(1, 512, None)]

    monkeypatch.undo()
    versions = train(tictactoe(steps=1024, **SETTINGS), registry=registry, resume=True)
    steps = [version.steps for version in versions]
    assert steps[:2] == [512, 1024]
    assert steps == sorted(set(steps))


SCRIPT = """
import sys
from league.registry.registry import Registry
from league.settings import Storage
from tests.training.test_run import tictactoe, SETTINGS
from training.run import train
train(tictactoe(steps=10**9, **SETTINGS), registry=Registry.open(Storage.at(sys.argv[1])))
"""


@pytest.mark.usefixtures("ray_session")
def test_a_killed_run_goes_on_without_losing_or_doubling_a_version(tmp_path: Path) -> None:
    """kill -9 of the driver, in the middle of training and publishing."""
    home = tmp_path / "home"
    driver = subprocess.Popen([sys.executable, "-c", SCRIPT, str(home)], stdout=subprocess.DEVNULL)
    try:
        registry = Registry.open(Storage.at(home))
        _wait_for_versions(registry, 2)
    finally:
        os.kill(driver.pid, signal.SIGKILL)
        driver.wait()
    before = registry.versions("tictactoe")
    budget = before[-1].steps + 4096
    versions = train(tictactoe(steps=budget, **SETTINGS), registry=registry, resume=True)
    assert [version.sha256 for version in versions[: len(before)]] == [version.sha256 for version in before]
    assert len({version.source for version in versions}) == len(versions)
    steps = [version.steps for version in versions]
    assert steps == sorted(set(steps))
    assert steps[-1] >= budget
    assert [version.parent for version in versions] == [None, *(version.number for version in versions[:-1])]


def _wait_for_versions(registry: Registry, count: int) -> None:
    deadline = time.monotonic() + DEADLINE
    while time.monotonic() < deadline:
        if any(row.slug == "tictactoe" for row in registry.leagues()) and len(registry.versions("tictactoe")) >= count:
            return
        time.sleep(0.1)
    raise AssertionError(f"no {count} versions within {DEADLINE} s")
