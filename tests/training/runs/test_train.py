"""Complete runs: Ray Tune, RLlib's Algorithm with a remote runner, publishing, interruption."""

import dataclasses
import io
import json
import re
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import closing, nullcontext
from pathlib import Path

import psutil
import pytest
from rich.console import Console
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from league.config.league import LeagueConfig
from league.environments.building import interface
from league.errors import ConfigError, EnvironmentMismatch, LeagueError, NotFound, ParityError, UnknownVersion
from league.refs import CheckpointRef
from league.registry.registry import Registry
from league.registry.storage.manifest import EXPLOITER
from league.registry.storage.rows import VersionRow
from league.settings import Storage
from tests.support.leagues.training_leagues import tictactoe
from tests.support.waiting import until
from training.export import publish as publishing
from training.runs.run_directory import RunDirectory
from training.runs.train import train
from training.runs.tune import Interrupted

SETTINGS = {"runners": 1, "train_batch_size": 256, "minibatch_size": 128, "epochs": 1, "checkpoint_every": 512}
LEAGUE = tictactoe(steps=1024, **SETTINGS)
LOCAL = {"runners": 0}
"""Sampling in the learner's process: a runner of its own takes seconds to start."""
DEADLINE = 120


@pytest.fixture
def registry(tmp_path: Path) -> Iterator[Registry]:
    registry = Registry.open(Storage.at(tmp_path / "home"))
    yield registry
    registry.close()


def lineage(versions: list[VersionRow]) -> list[tuple[int, int, int | None]]:
    return [(version.number, version.steps, version.parent) for version in versions]


def curves(run: Path) -> EventAccumulator:
    events = EventAccumulator(str(run / "attempt-1"))
    events.Reload()
    return events


@dataclasses.dataclass(frozen=True)
class Trained:
    """A run that has ended, its versions, and what it printed."""

    registry: Registry
    versions: list[VersionRow]
    output: str


@pytest.fixture(scope="module")
def trained(ray_session: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Trained]:
    registry = Registry.open(Storage.at(tmp_path_factory.mktemp("trained") / "home"))
    output, interrupt = io.StringIO(), signal.getsignal(signal.SIGINT)
    versions = train(LEAGUE, registry=registry, console=Console(file=output))
    assert signal.getsignal(signal.SIGINT) is interrupt, "Tune's SIGINT handler is restored"
    yield Trained(registry, versions, output.getvalue())
    registry.close()


@pytest.mark.slow
@pytest.mark.e2e
def test_a_run_publishes_its_checkpoints_and_its_curves(trained: Trained) -> None:
    registry = trained.registry
    assert lineage(trained.versions) == [(1, 512, None), (2, 1024, 1)]
    assert "Published tictactoe@1 after 512 steps" in trained.output
    assert "shared: return" in trained.output
    assert ": 1 runner of 4 environments, a learner of 1 thread." in trained.output
    assert "pettingzoo.classic.tictactoe_v3: It is vectorised by " in trained.output
    (run,) = (registry.storage.home / "runs" / "tictactoe").iterdir()
    assert not list(run.rglob("checkpoints/*")), "published checkpoints are deleted"
    tags = curves(run).Tags()["scalars"]
    of_policy = {"return", "length", "entropy", "policy_loss", "value_loss", "kl"}
    of_policy |= {"explained_variance", "gradient_norm"}
    assert {f"shared/{name}" for name in of_policy} <= set(tags)
    assert {"agents/player_1/return", "agents/player_2/length", "run/return", "run/crashes"} <= set(tags)
    assert {"run/steps_per_second", *(f"time/{name}" for name in ("waiting", "learning", "weights"))} <= set(tags)
    assert {"time/runners_sampling", "time/runners_idle"} <= set(tags)
    assert curves(run).Scalars("shared/entropy")[-1].step == 1024
    assert not any(tag.startswith("ray/") or "since_restore" in tag for tag in tags), "only curves are recorded"
    (record,) = registry.runs.newest("tictactoe")
    assert (record.id, record.state, record.steps, record.target) == (run.name, "ended", 1024, 1024)
    assert registry.runs.points("tictactoe", run.name)[-1].steps == 1024
    assert {f"shared/{name}" for name in of_policy} <= set(record.curves)
    of_agents = {name for name in record.curves if name.startswith("agents/")}
    assert of_agents == {"agents/player_1/return", "agents/player_2/return"}
    with pytest.raises(NotFound, match="complete"):
        train(LEAGUE, registry=registry, resume=True)


@pytest.mark.slow
def test_the_run_of_a_night_does_not_change_the_settings_of_its_league(trained: Trained) -> None:
    registry = trained.registry
    before = registry.leagues.get("tictactoe").config
    again = train(LEAGUE.with_training(steps=64, seed=5), registry=registry, name=trained.versions[0].run)
    assert [version.number for version in again] == [1, 2], "the run is complete"
    assert registry.leagues.get("tictactoe").config == before


@pytest.mark.parametrize(
    ("name", "how"), [(None, "To continue: --resume."), ("night-1", "To continue, run the same command again.")]
)
def test_an_interrupted_run_says_how_to_continue_it(
    registry: Registry, monkeypatch: pytest.MonkeyPatch, name: str | None, how: str
) -> None:
    """`league nightly` has no `--resume`."""
    registry.leagues.register(LEAGUE, interface(LEAGUE))
    monkeypatch.setattr("training.runs.train.connected", lambda *_: nullcontext())
    monkeypatch.setattr("training.runs.train.node_resources", lambda: [{"CPU": 2.0}])
    monkeypatch.setattr("training.runs.train.cluster_cpus", lambda: 2)
    monkeypatch.setattr("training.runs.train.RunDriver._attempts", lambda *_: False)
    with pytest.raises(Interrupted, match=re.escape(how)):
        train(LEAGUE, registry=registry, name=name, console=Console(quiet=True))


@pytest.mark.slow
def test_continued_training_has_a_parent(trained: Trained) -> None:
    first, second = train(
        LEAGUE.with_training(**LOCAL), registry=trained.registry, parent=CheckpointRef("tictactoe", 1)
    )
    assert lineage([first, second]) == [(first.number, 1024, 1), (second.number, 1536, first.number)]


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_run_is_resumed_after_its_parent_was_removed(trained: Trained) -> None:
    """It continues from its own version."""
    registry, league = trained.registry, LEAGUE.with_training(**LOCAL)
    parent = CheckpointRef("tictactoe", train(league.with_training(steps=512), registry=registry)[-1].number)
    versions = train(league.with_training(steps=512), registry=registry, parent=parent)
    registry.removal.remove_version(parent, force=True)
    resumed = train(league, registry=registry, resume=True)
    assert [(version.run, version.steps) for version in resumed] == [(versions[0].run, 1024), (versions[0].run, 1536)]


@pytest.mark.slow
def test_an_exploiter_is_trained_against_one_version(trained: Trained) -> None:
    registry = trained.registry
    registry.aliases.set("tictactoe", "champion", 1, expected=None, actor="test", reason="test")
    output = io.StringIO()
    target, settings = CheckpointRef("tictactoe", "champion"), LEAGUE.with_training(steps=512, exploiter={"gamma": 0.5})
    console = Console(file=output, width=200)
    (version,) = train(settings, registry=registry, role=EXPLOITER, target=target, console=console)
    assert (version.role, version.exploits, version.parent) == (EXPLOITER, "tictactoe@1", None)
    assert version.manifest.settings["opponents"]["fixed"] == [{"ref": "tictactoe@1", "share": 1.0}]
    assert version.manifest.settings["gamma"] == 0.5
    assert "Role: exploiter. Opponent in all episodes: tictactoe@1." in output.getvalue()
    registry.aliases.set("tictactoe", "champion", 2, expected=1, actor="test", reason="test")
    further = train(settings.with_training(steps=1024, **LOCAL), registry=registry, role=EXPLOITER, resume=True)
    assert [version.exploits for version in further] == ["tictactoe@1"] * 2


@pytest.mark.slow
@pytest.mark.usefixtures("ray_session")
def test_an_off_policy_run_publishes_and_continues(registry: Registry) -> None:
    """Versions, continued training without the replay buffer, and a version as opponent."""
    settings = {"algorithm": "dqn", "runners": 1, "steps": 2048, "checkpoint_every": 1024, "learning_starts": 256}
    league = tictactoe(**settings)
    versions = train(league, registry=registry, console=Console(file=io.StringIO()))
    assert lineage(versions) == [(1, 1024, None), (2, 2048, 1)]
    assert versions[0].manifest.algorithm == "dqn"
    output, parent = io.StringIO(), CheckpointRef("tictactoe", 1)
    further = league.with_training(steps=1024, opponents=["@1"], replay_in_checkpoint=False, **LOCAL)
    (version,) = train(further, registry=registry, parent=parent, console=Console(file=output))
    assert (version.steps, version.parent) == (2048, 1)
    assert "The replay buffer starts empty" in output.getvalue()
    with pytest.raises(ConfigError, match=r"training\.algorithm: tictactoe@1 was trained with dqn, got ppo"):
        train(tictactoe(), registry=registry, parent=CheckpointRef("tictactoe", 1))


@pytest.mark.slow
@pytest.mark.usefixtures("ray_session")
def test_a_recurrent_team_is_trained_and_continued(registry: Registry) -> None:
    """Trained by a remote runner, published, and continued; its versions do not contain the mixer."""
    config = LeagueConfig.load("policy_league/configs/two_step_game.yaml").with_training(
        runners=1, steps=2048, checkpoint_every=1024, recurrence={"width": 8, "sequence": 2}, batch_size=16
    )
    versions = train(config, registry=registry, console=Console(file=io.StringIO()))
    assert lineage(versions) == [(1, 1024, None), (2, 2048, 1)]
    policy = versions[1].manifest.policies["shared"]
    assert [tensor.name for tensor in policy.inputs if tensor not in policy.state] == ["observation"]
    assert [tensor.shape for tensor in policy.state] == [(None, 8), (None, 1)]
    assert [path.name for path in registry.artifacts.path("two_step_game", 2).glob("*.onnx")] == ["shared.onnx"]
    (run,) = (registry.storage.home / "runs" / "two_step_game").iterdir()
    assert {"joint/loss", "joint/value", "joint/error"} <= set(curves(run).Tags()["scalars"])
    parent = CheckpointRef("two_step_game", 1)
    (further,) = train(config.with_training(steps=1024, **LOCAL), registry=registry, parent=parent)
    assert (further.steps, further.parent) == (2048, 1)


def test_invalid_options_are_rejected_before_training(registry: Registry) -> None:
    with pytest.raises(ConfigError, match="either --from or --resume"):
        train(LEAGUE, registry=registry, parent=CheckpointRef("tictactoe", 1), resume=True)
    with pytest.raises(ConfigError, match="belongs to another league"):
        train(LEAGUE, registry=registry, parent=CheckpointRef("chess", 1))
    with pytest.raises(UnknownVersion):
        train(LEAGUE, registry=registry, parent=CheckpointRef("tictactoe", 1))
    with pytest.raises(ConfigError, match="kernel 4"):
        train(tictactoe(convolutions=[{"filters": 4, "kernel": 4}]), registry=registry)
    with pytest.raises(ConfigError, match=r"per_policy\.nobody"):
        train(tictactoe(per_policy={"nobody": {"lr": 1}}), registry=registry)
    with pytest.raises(UnknownVersion, match="no version 7"):
        train(tictactoe(opponents=["@7"]), registry=registry)
    for options in ({"role": EXPLOITER}, {"target": CheckpointRef("tictactoe", 1)}):
        with pytest.raises(ConfigError, match="--role exploiter and --against belong together"):
            train(LEAGUE, registry=registry, **options)
    with pytest.raises(EnvironmentMismatch, match="chess@1 is not a version of league tictactoe"):
        train(LEAGUE, registry=registry, role=EXPLOITER, target=CheckpointRef("chess", 1))
    team = LeagueConfig.load("policy_league/configs/two_step_game.yaml")
    with pytest.raises(ConfigError, match="--against: league two_step_game has one side only"):
        train(team, registry=registry, role=EXPLOITER, target=CheckpointRef("two_step_game", 1))
    adversary = LeagueConfig.load("policy_league/configs/simple_adversary.yaml")
    with pytest.raises(ConfigError, match="--against: maddpg does not support opponents"):
        train(adversary, registry=registry, role=EXPLOITER, target=CheckpointRef("simple_adversary", 1))
    assert not (registry.storage.home / "runs").exists()


@pytest.mark.usefixtures("ray_session")
def test_what_the_machine_lacks_is_refused_before_a_run_begins(registry: Registry) -> None:
    with pytest.raises(ConfigError, match="1 GPUs requested in total, but Ray has 0"):
        train(tictactoe(gpus=1), registry=registry)
    with pytest.raises(ConfigError, match=r"training\.learners: expected 1, .* \(training\.gpus is 0\), got 2"):
        train(tictactoe(learners=2), registry=registry)
    assert not (registry.storage.home / "runs").exists()
    run = RunDirectory.begin(registry.storage, tictactoe(learners=2), None, None)
    with pytest.raises(ConfigError, match=r"training\.learners: expected 1"):
        train(tictactoe(), registry=registry, resume=True)
    assert not run.attempts()


@pytest.mark.slow
@pytest.mark.usefixtures("ray_session")
def test_a_failed_parity_check_ends_the_run_and_keeps_earlier_versions(
    registry: Registry, monkeypatch: pytest.MonkeyPatch
) -> None:
    check_parity, outcomes = publishing.parity.check_parity, iter([True, False, False])

    def check_once(*arguments: object) -> object:
        if not next(outcomes):
            raise ParityError("the graph differs")
        return check_parity(*arguments)

    monkeypatch.setattr(publishing.parity, "check_parity", check_once)
    with pytest.raises(ParityError, match="the graph differs"):
        train(tictactoe(steps=4096, **SETTINGS | LOCAL), registry=registry)
    assert lineage(registry.versions.all("tictactoe")) == [(1, 512, None)]
    (record,) = registry.runs.newest("tictactoe")
    assert (record.state, record.error) == ("failed", "the graph differs")

    monkeypatch.undo()
    versions = train(tictactoe(steps=1024, **SETTINGS | LOCAL), registry=registry, resume=True)
    steps = [version.steps for version in versions]
    assert steps[:2] == [512, 1024]
    assert steps == sorted(set(steps))


RAISED = ("league faulty", "ZeroDivisionError: division by zero", "faulty.py:13", "attempt-1/error.txt")


@pytest.mark.slow
@pytest.mark.usefixtures("ray_session")
@pytest.mark.parametrize(
    ("entry_point", "runners", "messages"),
    [("raising", 1, RAISED), ("unrewarding", 0, ("faulty", "player_1", "nan"))],
)
def test_a_fault_of_the_environment_is_one_sentence(
    registry: Registry, entry_point: str, runners: int, messages: tuple[str, ...]
) -> None:
    league = LeagueConfig.from_mapping(
        {
            "league": "faulty",
            "environment": {"entry_point": f"tests.support.environments.faulty:{entry_point}"},
            "policies": {"first": ["player_0"], "second": ["player_1"]},
            "training": {"runners": runners, "num_envs": 2, "hidden": [8], "crashes": 1},
        }
    )
    with pytest.raises(LeagueError) as raised:
        train(league, registry=registry)
    for word in messages:
        assert word in str(raised.value)
    assert "\n" not in str(raised.value)
    if entry_point == "raising":
        (trace,) = registry.storage.home.rglob("error.txt")
        assert "ZeroDivisionError" in trace.read_text()


SCRIPT = """
import sys
from league.registry.registry import Registry
from league.settings import Storage
from tests.training.runs.test_train import SLOW
from training.runs.train import train
train(SLOW, registry=Registry.open(Storage.at(sys.argv[1])))
"""
SLOW = tictactoe(steps=1536, **SETTINGS | {"epochs": 16, "minibatch_size": 32})
"""Long enough to be killed between two checkpoints."""


@pytest.fixture(scope="module")
def uninterrupted(ray_session: None, tmp_path_factory: pytest.TempPathFactory) -> list[VersionRow]:
    """The versions of a run that was not killed."""
    with closing(Registry.open(Storage.at(tmp_path_factory.mktemp("whole")))) as registry:
        return train(SLOW, registry=registry)


@pytest.fixture(scope="module")
def interrupted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The home of a run whose driver was killed with SIGKILL after its first checkpoint."""
    home = tmp_path_factory.mktemp("interrupted") / "home"
    driver = subprocess.Popen([sys.executable, "-c", SCRIPT, str(home)], stdout=subprocess.DEVNULL)
    try:
        until(lambda: any(home.glob("runs/tictactoe/*/attempt-1/checkpoints/512")), DEADLINE)
    finally:
        workers = psutil.Process(driver.pid).children(recursive=True)
        driver.kill()
        driver.wait()
    _, running = psutil.wait_procs(workers, DEADLINE)
    assert not running, "Ray's processes end with their driver"
    return home


@pytest.mark.slow
@pytest.mark.parametrize("home_is_lost", [False, True], ids=["same machine", "other machine"])
def test_a_killed_run_publishes_the_same_versions_after_resuming(
    tmp_path: Path, uninterrupted: list[VersionRow], interrupted: Path, home_is_lost: bool
) -> None:
    """It is resumed on a machine that has its directory, or has only the registry and the versions."""
    home = shutil.copytree(interrupted, tmp_path / "home")
    killed = Registry.open(Storage.at(home))
    before = killed.versions.all("tictactoe")
    assert len(before) < 3, "the driver was killed too late"
    if home_is_lost:
        shutil.rmtree(home / "runs")
    resumed = train(SLOW, registry=killed, resume=True)

    assert [version.steps for version in uninterrupted] == [512, 1024, 1536]
    assert [graphs(version) for version in resumed] == [graphs(version) for version in uninterrupted]
    assert len({json.dumps(graphs(version)) for version in uninterrupted}) == 3, "the weights must change"
    assert [version.sha256 for version in resumed[: len(before)]] == [version.sha256 for version in before]
    assert [version.parent for version in resumed] == [None, *(version.number for version in resumed[:-1])]
    (record,) = killed.runs.newest("tictactoe")
    assert (record.state, record.attempts, record.steps) == ("ended", 2, 1536)
    steps = [point.steps for point in killed.runs.points("tictactoe", record.id)]
    assert steps == sorted(steps)


@pytest.mark.slow
def test_a_lost_process_is_replaced(ray_session: None, registry: Registry) -> None:
    """A run continues from its newest version."""
    league = tictactoe(steps=2560, **SETTINGS | {"minibatch_size": 32, "epochs": 64})
    home = registry.storage.home

    def kill() -> None:
        until(lambda: any(home.glob("runs/tictactoe/*/attempt-1/checkpoints/512")), DEADLINE)
        workers = psutil.Process().children(recursive=True)
        next(worker for worker in workers if "BatchedEnvRunner" in "".join(worker.cmdline())).kill()

    output, killer = io.StringIO(), threading.Thread(target=kill)
    killer.start()
    versions = train(league, registry=registry, console=Console(file=output, width=200))
    killer.join()
    assert [version.steps for version in versions] == [512, 1024, 1536, 2048, 2560]
    assert "A process was lost" in output.getvalue()
    (record,) = registry.runs.newest("tictactoe")
    assert (record.state, record.attempts) == ("ended", 2)


def graphs(version: VersionRow) -> dict[str, str]:
    """The digest of each ONNX file."""
    return {name: digest for name, digest in version.manifest.files.items() if name.endswith(".onnx")}
