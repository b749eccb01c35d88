"""`league train` and `league sweep` as a person runs them, and ends them."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import httpx
import pytest
import yaml

from league.registry.registry import Registry
from league.settings import Storage
from serve_app.haproxy import free_ports
from tests.cli.conftest import League

DEADLINE = 180
COMMAND = (sys.executable, "-c", "from cli.main import run; run()")
TRAINING = {
    "runners": 1, "copies": 4, "hidden": [16], "train_batch_size": 256, "minibatch_size": 128, "epochs": 1,
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
def started(home: Path) -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Start the command in a process group of its own, as a shell does for a terminal."""
    processes = []

    def start(*arguments: str) -> subprocess.Popen[str]:
        processes.append(
            subprocess.Popen(
                [*COMMAND, *arguments],
                env=os.environ | {"LEAGUE_HOME": str(home), "COLUMNS": "200", "NO_COLOR": "1"},
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


def wait_for(is_there: Callable[[], bool]) -> None:
    deadline = time.monotonic() + DEADLINE
    while not is_there():
        assert time.monotonic() < deadline, f"not within {DEADLINE} s"
        time.sleep(0.05)


def test_ctrl_c_publishes_what_there_is_and_a_second_one_ends_at_once(
    started: Callable[..., subprocess.Popen[str]], config: Path, home: Path
) -> None:
    first = started("train", str(config))
    wait_for(lambda: any(home.glob("artifacts/tictactoe/1/manifest.json")))
    os.killpg(first.pid, signal.SIGINT)
    out, _ = first.communicate(timeout=DEADLINE)
    assert first.returncode == 130, out
    assert "Traceback" not in out
    versions = Registry.open(Storage.at(home)).versions("tictactoe")
    assert f"Ended early. Published: {', '.join(version.ref for version in versions)}." in out
    assert "--resume" in out
    (run,) = home.glob("runs/tictactoe/*/run.json")
    assert str(run.parent) in out, "where the curves are"
    assert not json.loads(run.read_text())["complete"]
    assert not list(run.parent.glob("life-*/checkpoints/*")), "all that was learned is published"

    second = started("train", str(config), "--resume")
    wait_for(lambda: len(Registry.open(Storage.at(home)).versions("tictactoe")) > len(versions))
    os.killpg(second.pid, signal.SIGINT)
    wait_for(lambda: any(home.glob("runs/tictactoe/*/life-2/end")))
    os.killpg(second.pid, signal.SIGINT)
    out, _ = second.communicate(timeout=DEADLINE)
    assert second.returncode == 130, out
    assert "Traceback" not in out

    later = Registry.open(Storage.at(home)).versions("tictactoe")
    budget = f"--steps={later[-1].steps + 256}"
    third = started("train", str(config), "--resume", budget)
    out, _ = third.communicate(timeout=DEADLINE)
    assert third.returncode == 0, out
    last = Registry.open(Storage.at(home)).versions("tictactoe")
    assert [version.ref for version in last[: len(later)]] == [version.ref for version in later]
    assert last[-1].steps >= later[-1].steps + 256
    assert [version.steps for version in last] == sorted({version.steps for version in last})


def test_a_sweep_prints_its_trials_and_the_best_ones_settings(league: League, config: Path, home: Path) -> None:
    outcome = league("sweep", str(config), "--steps=256", "--cpus=2", "--dashboard", timeout=DEADLINE)
    assert outcome.code == 0, outcome.err
    assert "Ray's dashboard: http://127.0.0.1:" in outcome.out
    lines = [line.split() for line in outcome.out.splitlines()]
    rows = [line for line in lines if line[:1] in (["0"], ["1"]) and "of" not in line]
    assert [row[1:3] for row in rows] == [["[8]", "0.01"], ["[16]", "0.01"]]
    best = max(range(2), key=lambda number: float(rows[number][3]))
    assert f"Trial {best} is the best." in outcome.out
    snippet = outcome.out.partition("Its settings:")[2].partition("Published")[0]
    assert yaml.safe_load(snippet) == {
        "training": {"hidden": [[8], [16]][best], "per_policy": {"shared": {"lr": 0.01}}},
    }
    assert "Published it as tictactoe@1." in outcome.out
    assert len(list(home.glob("sweeps/tictactoe/*/trial-*/outcome.json"))) == 2


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--job",), "--job needs --address http://HOST:8265"),
        (("--job", "--address", "127.0.0.1:6379"), "expected --address http://HOST:8265"),
        (("--job", "--address", "http://127.0.0.1:9"), "no Ray dashboard at http://127.0.0.1:9"),
        (("--job", "--address", "http://192.0.2.77:8265"), "192.0.2.77 is another machine: set LEAGUE_DATABASE_URL"),
        (("--address", "127.0.0.1:9", "--cpus", "1"), "for a local Ray"),
        (("--object-store", "5"), "at least 80 MB, got 5"),
        (("--gpus", "64"), "64 GPUs are asked for"),
        (("--resume",), "nothing to resume"),
    ],
)
def test_what_cannot_be_is_refused_in_a_line(
    league: League, config: Path, arguments: tuple[str, ...], words: str
) -> None:
    outcome = league("train", str(config), *arguments)
    assert outcome.code == 2, outcome.err
    assert outcome.err.startswith("league: ")
    assert outcome.err.count("\n") == 1
    assert words in outcome.err


@pytest.fixture
def cluster() -> Iterator[str]:
    """A cluster of one machine, with ports of its own, as other Rays may be running; the address of its dashboard."""
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
    """Whether something answers, if only that it wants a token."""
    try:
        httpx.get(address)
    except httpx.TransportError:
        return False
    return True


def test_training_as_a_job_of_a_cluster(league: League, config: Path, home: Path, cluster: str) -> None:
    wait_for(lambda: is_up(cluster))
    outcome = league("train", str(config), "--job", "--address", cluster, "--steps=256", timeout=DEADLINE)
    assert outcome.code == 0, outcome.out + outcome.err
    assert "To stop it: ray job stop raysubmit_" in outcome.out
    assert "Published tictactoe@1." in outcome.out
    (version,) = Registry.open(Storage.at(home)).versions("tictactoe")
    assert version.steps == 256

    outcome = league("train", str(config), "--job", "--address", cluster, "--from=@7", timeout=DEADLINE)
    assert outcome.code == 1
    assert "has no version 7" in outcome.out
    assert outcome.err.startswith("league: job raysubmit_")
