"""Whole runs: Ray Tune, RLlib's Algorithm with a remote runner, publishing, interruption."""

import dataclasses
import io
import json
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

from league.config import LeagueConfig
from league.errors import ConfigError, LeagueError, NotFound, ParityError, UnknownVersion
from league.refs import CheckpointRef
from league.registry.registry import Registry
from league.registry.rows import VersionRow
from league.settings import Storage
from tests.training.leagues import tictactoe
from training import publish as publishing
from training.run import check_network, train

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
    of_policy = {
        "return",
        "length",
        "entropy",
        "policy_loss",
        "value_loss",
        "kl",
        "explained_variance",
        "gradient_norm",
    }
    assert {f"shared/{name}" for name in of_policy} <= set(tags)
    assert {"agents/player_1/return", "agents/player_2/length", "run/return", "run/crashes"} <= set(tags)
    assert {"run/steps_per_second", *(f"time/{name}" for name in ("sampling", "learning", "weights"))} <= set(tags)
    assert curves(run).Scalars("shared/entropy")[-1].step == 1024
    assert not any(tag.startswith("ray/") or "since_restore" in tag for tag in tags), "curves alone"
    (told,) = registry.runs("tictactoe")
    assert (told.id, told.state, told.steps, told.target) == (run.name, "ended", 1024, 1024)
    assert registry.run_points("tictactoe", run.name)[-1].steps == 1024
    assert {f"shared/{name}" for name in of_policy} <= set(told.curves)
    assert not any(name.startswith("agents/") for name in told.curves)
    with pytest.raises(NotFound, match="complete"):
        train(LEAGUE, registry=registry, resume=True)

    further = train(LEAGUE, registry=registry, parent=CheckpointRef("tictactoe", 1))
    assert lineage(further) == [(3, 1024, 1), (4, 1536, 3)]


@pytest.mark.usefixtures("ray_session")
def test_an_off_policy_run_goes_the_same_way(registry: Registry) -> None:
    """Versions, further training from one with its buffer or without, and one as an opponent."""
    settings = {"algorithm": "dqn", "runners": 1, "steps": 2048, "checkpoint_every": 1024, "learning_starts": 256}
    league = tictactoe(**settings)
    versions = train(league, registry=registry, console=Console(file=io.StringIO()))
    assert lineage(versions) == [(1, 1024, None), (2, 2048, 1)]
    assert versions[0].manifest.algorithm == "dqn"
    for kept in (True, False):
        shown, parent = io.StringIO(), CheckpointRef("tictactoe", 1)
        further = league.with_training(steps=1024, opponents=["@1"], replay_in_checkpoint=kept)
        (version,) = train(further, registry=registry, parent=parent, console=Console(file=shown))
        assert (version.steps, version.parent) == (2048, 1)
        assert ("The replay buffer begins empty" in shown.getvalue()) is not kept
    with pytest.raises(ConfigError, match=r"training\.algorithm: tictactoe@1 was trained with dqn, got ppo"):
        train(tictactoe(), registry=registry, parent=CheckpointRef("tictactoe", 1))
    with pytest.raises(ConfigError, match=r"training\.dueling: tictactoe@1 was trained with True, got False"):
        train(league.with_training(dueling=False), registry=registry, parent=CheckpointRef("tictactoe", 1))


@pytest.mark.usefixtures("ray_session")
def test_a_team_with_a_memory_goes_the_same_way(registry: Registry) -> None:
    """Trained by a remote runner, published, and trained on; its versions know nothing of the mixer."""
    config = LeagueConfig.load("configs/two_step_game.yaml").with_training(
        runners=1, steps=2048, checkpoint_every=1024, recurrence={"width": 8, "sequence": 2}, batch_size=16
    )
    versions = train(config, registry=registry, console=Console(file=io.StringIO()))
    assert lineage(versions) == [(1, 1024, None), (2, 2048, 1)]
    policy = versions[1].manifest.policies["shared"]
    assert [tensor.name for tensor in policy.inputs if tensor not in policy.state] == ["observation"]
    assert [tensor.shape for tensor in policy.state] == [(None, 8), (None, 1)]
    assert [path.name for path in registry.fetch("two_step_game", 2).glob("*.onnx")] == ["shared.onnx"]
    (run,) = (registry.storage.home / "runs" / "two_step_game").iterdir()
    assert {"joint/loss", "joint/value", "joint/error"} <= set(curves(run).Tags()["scalars"])
    parent = CheckpointRef("two_step_game", 1)
    (further,) = train(config.with_training(steps=1024), registry=registry, parent=parent)
    assert (further.steps, further.parent) == (2048, 1)
    with pytest.raises(ConfigError, match=r"training\.mixer: two_step_game@1 was trained with qmix, got vdn"):
        train(config.with_training(mixer="vdn"), registry=registry, parent=parent)


def test_what_cannot_be_trained_is_refused_before_anything_starts(registry: Registry) -> None:
    with pytest.raises(ConfigError, match="either --from or --resume"):
        train(LEAGUE, registry=registry, parent=CheckpointRef("tictactoe", 1), resume=True)
    with pytest.raises(ConfigError, match="of another league"):
        train(LEAGUE, registry=registry, parent=CheckpointRef("chess", 1))
    with pytest.raises(UnknownVersion):
        train(LEAGUE, registry=registry, parent=CheckpointRef("tictactoe", 1))
    with pytest.raises(ConfigError, match="kernel of 4"):
        train(tictactoe(convolutions=[{"filters": 4, "kernel": 4}]), registry=registry)
    with pytest.raises(ConfigError, match=r"per_policy\.nobody"):
        train(tictactoe(per_policy={"nobody": {"lr": 1}}), registry=registry)
    with pytest.raises(UnknownVersion, match="no version 7"):
        train(tictactoe(opponents=["@7"]), registry=registry)
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
    (told,) = registry.runs("tictactoe")
    assert (told.state, told.error) == ("failed", "the graph differs")

    monkeypatch.undo()
    versions = train(tictactoe(steps=1024, **SETTINGS), registry=registry, resume=True)
    steps = [version.steps for version in versions]
    assert steps[:2] == [512, 1024]
    assert steps == sorted(set(steps))


@pytest.mark.usefixtures("ray_session")
def test_a_version_is_trained_on_with_the_network_that_it_has(registry: Registry) -> None:
    """Settings that were not there yet when the version was trained have their defaults."""
    (version,) = train(tictactoe(steps=64, train_batch_size=64, minibatch_size=64), registry=registry)
    for setting in ({"hidden": [8]}, {"recurrence": {"width": 4}}, {"normalize_observations": True}):
        with pytest.raises(ConfigError, match=f"training.{next(iter(setting))}: tictactoe@1 was trained with"):
            train(tictactoe(**setting), registry=registry, parent=CheckpointRef("tictactoe", 1))
    old = {key: value for key, value in version.manifest.settings.items() if key not in ("recurrence", "opponents")}
    manifest = version.manifest.model_copy(update={"settings": old})
    check_network(dataclasses.replace(version, manifest=manifest), tictactoe())


@pytest.mark.usefixtures("ray_session")
@pytest.mark.parametrize(
    ("entry_point", "words"),
    [
        ("raising", ("league faulty", "ZeroDivisionError: division by zero", "faulty.py:13", "life-1/error.txt")),
        ("unrewarding", ("faulty", "player_1", "nan")),
    ],
)
def test_a_fault_of_the_environment_in_a_runner_is_told_in_a_sentence(
    registry: Registry, entry_point: str, words: tuple[str, ...]
) -> None:
    league = LeagueConfig.from_mapping(
        {
            "league": "faulty",
            "environment": {"entry_point": f"tests.training.faulty:{entry_point}"},
            "policies": {"first": ["player_0"], "second": ["player_1"]},
            "training": {"runners": 1, "copies": 2, "hidden": [8], "crashes": 1},
        }
    )
    with pytest.raises(LeagueError) as raised:
        train(league, registry=registry)
    for word in words:
        assert word in str(raised.value)
    assert "\n" not in str(raised.value)
    if entry_point == "raising":
        (trace,) = registry.storage.home.rglob("error.txt")
        assert "ZeroDivisionError" in trace.read_text()


SCRIPT = """
import sys
from league.registry.registry import Registry
from league.settings import Storage
from tests.training.test_run import SLOW
from training.run import train
train(SLOW, registry=Registry.open(Storage.at(sys.argv[1])))
"""
SLOW = tictactoe(steps=1536, **SETTINGS | {"epochs": 16, "minibatch_size": 32})
"""Long enough between two checkpoints to be killed there."""


@pytest.mark.usefixtures("ray_session")
def test_a_run_that_is_killed_and_goes_on_publishes_what_one_that_was_not_does(tmp_path: Path) -> None:
    """kill -9 of the driver in the middle."""
    home = tmp_path / "killed"
    driver = subprocess.Popen([sys.executable, "-c", SCRIPT, str(home)], stdout=subprocess.DEVNULL)
    try:
        _wait_for_checkpoint(home)
    finally:
        os.kill(driver.pid, signal.SIGKILL)
        driver.wait()
    killed = Registry.open(Storage.at(home))
    before = killed.versions("tictactoe")
    assert len(before) < 3, "it was not killed in the middle"
    resumed = train(SLOW, registry=killed, resume=True)

    whole = train(SLOW, registry=Registry.open(Storage.at(tmp_path / "whole")))
    assert [version.steps for version in whole] == [512, 1024, 1536]
    assert [graphs(version) for version in resumed] == [graphs(version) for version in whole]
    assert len({json.dumps(graphs(version)) for version in whole}) == 3, "it learns"
    assert [version.sha256 for version in resumed[: len(before)]] == [version.sha256 for version in before]
    assert [version.parent for version in resumed] == [None, *(version.number for version in resumed[:-1])]
    (told,) = killed.runs("tictactoe")
    assert (told.state, told.lives, told.steps) == ("ended", 2, 1536)
    steps = [point.steps for point in killed.run_points("tictactoe", told.id)]
    assert steps == sorted(steps)


def graphs(version: VersionRow) -> dict[str, str]:
    """The digest of each ONNX file."""
    return {name: digest for name, digest in version.manifest.files.items() if name.endswith(".onnx")}


def _wait_for_checkpoint(home: Path) -> None:
    deadline = time.monotonic() + DEADLINE
    while time.monotonic() < deadline:
        if any(path.name == "512" for path in home.glob("runs/tictactoe/*/life-1/checkpoints/*")):
            return
        time.sleep(0.01)
    raise AssertionError(f"no checkpoint within {DEADLINE} s")
