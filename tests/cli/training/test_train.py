"""`league train` and `league sweep` as run and interrupted by a user."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import httpx
import pytest
import yaml

from league.local_ray import token
from league.registry.registry import Registry
from league.settings import Storage
from policy_league.cli.training.train import next_step
from serve_app.runtime.haproxy import free_ports
from tests.support.command import COMMAND, League, environment
from tests.support.leagues import tictactoe
from tests.support.waiting import until

DEADLINE = 300


TRAINING = {
    "runners": 1, "num_envs": 4, "hidden": [16], "train_batch_size": 256, "minibatch_size": 128, "epochs": 1,
    "checkpoint_every": 1024, "steps": 10**9,
}  # fmt: skip


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "tictactoe.yaml"
    environment = {"entry_point": "pettingzoo.classic.tictactoe_v3"}
    sweep = {"parameters": {"hidden": [[8], [16]], "per_policy.shared.lr": [0.01]}, "metric": "shared/length"}
    document = {"league": "tictactoe", "environment": environment, "training": TRAINING, "sweep": sweep}
    path.write_text(yaml.safe_dump(document))
    return path


@pytest.fixture
def start_command(home: Path) -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Start the command in its own process group, like a shell in a terminal."""
    processes = []

    def start(*arguments: str) -> subprocess.Popen[str]:
        processes.append(
            subprocess.Popen(
                [*COMMAND, *arguments],
                env=os.environ | environment(home),
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                start_new_session=True,
            )
        )
        return processes[-1]

    yield start
    for process in processes:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_closed_terminal_publishes_the_current_checkpoint_and_a_second_ctrl_c_exits_at_once(
    start_command: Callable[..., subprocess.Popen[str]], config: Path, home: Path
) -> None:
    first = start_command("train", str(config))
    until(lambda: any(home.glob("artifacts/tictactoe/1/manifest.json")), DEADLINE)
    os.killpg(first.pid, signal.SIGHUP)
    out, _ = first.communicate(timeout=DEADLINE)
    assert first.returncode == 129, out
    assert "Traceback" not in out
    versions = Registry.open(Storage.at(home)).versions.all("tictactoe")
    assert f"Ended early. Published: {', '.join(version.ref for version in versions)}." in out
    assert "--resume" in out
    (run,) = home.glob("runs/tictactoe/*/run.json")
    assert str(run.parent) in out, "the directory of the curves is printed"
    assert not json.loads(run.read_text())["complete"]
    assert not list(run.parent.glob("attempt-*/checkpoints/*")), "all checkpoints are published"

    second = start_command("train", str(config), "--resume")
    until(lambda: len(Registry.open(Storage.at(home)).versions.all("tictactoe")) > len(versions), DEADLINE)
    os.killpg(second.pid, signal.SIGINT)
    until(lambda: any(home.glob("runs/tictactoe/*/attempt-2/stop")), DEADLINE)
    os.killpg(second.pid, signal.SIGINT)
    out, _ = second.communicate(timeout=DEADLINE)
    assert second.returncode == 130, out
    assert "Traceback" not in out

    later = Registry.open(Storage.at(home)).versions.all("tictactoe")
    budget = f"--steps={later[-1].steps + 256}"
    third = start_command("train", str(config), "--resume", budget, "--cpus=2", "--dashboard")
    out, _ = third.communicate(timeout=DEADLINE)
    assert third.returncode == 0, out
    assert "Ray's dashboard: http://127.0.0.1:" in out
    last = Registry.open(Storage.at(home)).versions.all("tictactoe")
    assert [version.ref for version in last[: len(later)]] == [version.ref for version in later]
    assert last[-1].steps >= later[-1].steps + 256
    assert [version.steps for version in last] == sorted({version.steps for version in last})


@pytest.mark.slow
@pytest.mark.usefixtures("ray_session")
def test_a_run_repeats_the_resources_of_a_version(league: League, config: Path) -> None:
    document = yaml.safe_load(config.read_text())
    document["training"] |= {"runners": "auto", "steps": 256}
    config.write_text(yaml.safe_dump(document))
    for arguments in (["--runners=0"], ["--like=@1"]):
        result = league("train", str(config), *arguments)
        assert result.code == 0, result.err
        assert "2 cores: 4 environments in the learner's process, a learner of 2 threads." in result.out
    result = league("train", str(config), "--like=@1", "--runners=1")
    assert "2 cores: 1 runner of 4 environments, a learner of 2 threads." in result.out


@pytest.mark.slow
@pytest.mark.usefixtures("ray_session")
def test_a_sweep_prints_its_trials_and_the_best_settings(league: League, config: Path, home: Path) -> None:
    result = league("sweep", str(config), "--steps=256", "--runners=0")
    assert result.code == 0, result.err
    lines = [line.split() for line in result.out.splitlines()]
    rows = [line for line in lines if line[:1] in (["0"], ["1"]) and "of" not in line]
    assert [row[1:3] for row in rows] == [["[8]", "0.01"], ["[16]", "0.01"]]
    best = max(range(2), key=lambda number: float(rows[number][3]))
    assert f"Best trial: {best}." in result.out
    snippet = result.out.partition("Settings:")[2].partition("Published")[0]
    assert yaml.safe_load(snippet) == {
        "training": {"hidden": [[8], [16]][best], "per_policy": {"shared": {"lr": 0.01}}},
    }
    assert "Published as tictactoe@1." in result.out
    assert len(list(home.glob("sweeps/tictactoe/*/trial-*/outcome.json"))) == 2


def refused(league: League, config: Path, *arguments: str) -> str:
    """The only line of a refusal to train."""
    result = league("train", str(config), *arguments)
    assert (result.code, result.err.count("\n"), result.err.startswith("league: ")) == (2, 1, True), result.err
    return result.err


def test_invalid_options_are_rejected_in_one_line(
    league: League, config: Path, monkeypatch: pytest.MonkeyPatch, subtests: pytest.Subtests
) -> None:
    """A job gets no password."""
    for name in (token.MODE, token.TOKEN, token.TOKEN_FILE):  # of a Ray that other tests of this process share
        monkeypatch.delenv(name, raising=False)
    for arguments, message in (
        (("--job",), "--job requires --address http://HOST:8265"),
        (("--job", "--address", "127.0.0.1:6379"), "expected --address http://HOST:8265"),
        (("--job", "--address", "http://127.0.0.1:9"), "no Ray dashboard at http://127.0.0.1:9"),
        (("--job", "--address", "http://192.0.2.77:8265"), "192.0.2.77 is another machine: set LEAGUE_DATABASE_URL"),
        (("--address", "127.0.0.1:9", "--cpus", "1"), "for a local Ray"),
        (("--object-store", "5"), "at least 80 MB, got 5"),
        (("--resume",), "nothing to resume"),
    ):
        with subtests.test(arguments=arguments):
            assert message in refused(league, config, *arguments)
    monkeypatch.setenv("LEAGUE_DATABASE_URL", "postgresql://league:secret@127.0.0.1:9/league")
    message = refused(league, config, "--job", "--address", "http://127.0.0.1:9")
    assert ("LEAGUE_DATABASE_URL contains a password" in message, "secret" in message) == (True, False)


@pytest.mark.slow
def test_more_gpus_than_there_are_is_rejected(league: League, config: Path) -> None:
    assert "64 GPUs requested" in refused(league, config, "--gpus", "64")


@pytest.fixture
def cluster() -> Iterator[str]:
    """A cluster of one machine with its own ports, as other Ray instances may be running; yields the address of its
    dashboard.
    """
    gcs, dashboard, agent = free_ports(3, "127.0.0.1")
    ports = {"port": gcs, "dashboard-port": dashboard, "dashboard-agent-listen-port": agent}
    command = [str(Path(sys.executable).with_name("ray")), "start", "--head", "--block", "--num-cpus=2"]
    command += [f"--{name}={port}" for name, port in ports.items()]
    ray = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        yield f"http://127.0.0.1:{dashboard}"
    finally:
        ray.terminate()
        ray.wait(DEADLINE)


def is_up(address: str) -> bool:
    """Whether the address responds, even if only to require a token."""
    try:
        httpx.get(address)
    except httpx.TransportError:
        return False
    return True


@pytest.mark.slow
def test_training_as_a_job_of_a_cluster(league_process: League, config: Path, home: Path, cluster: str) -> None:
    until(lambda: is_up(cluster), DEADLINE)
    result = league_process("train", str(config), "--job", "--address", cluster, "--steps=256", timeout=DEADLINE)
    assert result.code == 0, result.out + result.err
    assert "To stop it: ray job stop raysubmit_" in result.out
    assert "Published tictactoe@1." in result.out
    (version,) = Registry.open(Storage.at(home)).versions.all("tictactoe")
    assert version.steps == 256

    result = league_process("train", str(config), "--job", "--address", cluster, "--from=@7", timeout=DEADLINE)
    assert result.code == 1
    assert "has no version 7" in result.out
    assert result.err.startswith("league: job raysubmit_")


def test_the_next_step_depends_on_the_role(registry: Registry) -> None:
    main = registry.versions.get("tictactoe", 3)
    exploiter = tictactoe.publish(registry, tictactoe.graph(wins=True), exploits=main.ref)
    assert next_step("tictactoe.yaml", main).startswith("league nightly tictactoe.yaml ")
    assert next_step("my games/a.yaml", main).startswith("league nightly 'my games/a.yaml' ")
    assert next_step("tictactoe.yaml", exploiter).startswith("league exploitability tictactoe@3 ")
