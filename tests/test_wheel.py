"""The wheels are complete: commands work with a wheel and what it requires, in an empty directory."""

import re
import shutil
import signal
import subprocess
import tomllib
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import pytest

from policy_league_client import __version__
from scripts.without_trainer import without_trainer
from serve_app.runtime.haproxy import free_ports
from tests.support.installation import CLEAN, installed, wheel_of
from tests.support.leagues import tictactoe
from tests.support.waiting import until

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1200)]

ROOT = Path(__file__).parent.parent
PACKAGES = ("evaluation", "league", "policy_league", "policy_league_client", "serve_app", "training")
CLIENT = "clients/python/"
ENVIRONMENT = CLEAN | {"COLUMNS": "200", "NO_COLOR": "1"}

Installed = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return wheel_of(ROOT, tmp_path_factory.mktemp("dist"))


@pytest.fixture(scope="module")
def league(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The `league` script of an environment with `policy-league`."""
    return installed(wheel, tmp_path_factory.mktemp("environment")) / "league"


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The `league` script of an environment with the packages of the server's image."""
    source = tmp_path_factory.mktemp("source")
    for name in tracked("."):
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / name, source / name, follow_symlinks=False)
    project = source / "pyproject.toml"
    project.write_text(without_trainer(project.read_text()))
    wheel = wheel_of(source, tmp_path_factory.mktemp("server-dist"))
    return installed(wheel, tmp_path_factory.mktemp("server"), "object-store", "postgres") / "league"


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Python in an environment with `policy-league-client`."""
    wheel = wheel_of(ROOT / CLIENT, tmp_path_factory.mktemp("client-dist"))
    assert __version__ in wheel.name
    return installed(wheel, tmp_path_factory.mktemp("client")) / "python"


def tracked(*paths: str) -> list[str]:
    """The files of the repository below these paths."""
    listed = subprocess.run(["git", "ls-files", *paths], cwd=ROOT, check=True, capture_output=True, text=True)
    return listed.stdout.splitlines()


@pytest.fixture(scope="module")
def directory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("empty")


@pytest.fixture
def run(league: Path, directory: Path) -> Installed:
    def command(*arguments: str, timeout: float = 600) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [str(league), *arguments], cwd=directory, env=ENVIRONMENT, capture_output=True, text=True, timeout=timeout
        )

    return command


@pytest.mark.e2e
def test_the_wheel_contains_all_tracked_files_of_the_packages(wheel: Path) -> None:
    files = {name.removeprefix(CLIENT) for name in tracked(*PACKAGES[:3], *PACKAGES[4:], f"{CLIENT}{PACKAGES[3]}")}
    with zipfile.ZipFile(wheel) as archive:
        assert files - set(archive.namelist()) == set()
        assert archive.read("serve_app/deploy.yaml") == (ROOT / "deploy.yaml").read_bytes()
        (top_level,) = [name for name in archive.namelist() if name.endswith("top_level.txt")]
        assert tuple(archive.read(top_level).decode().split()) == PACKAGES


@pytest.mark.e2e
def test_modules_come_from_the_wheel(league: Path, directory: Path) -> None:
    program = f"import importlib; print(*(importlib.import_module(name).__file__ for name in {PACKAGES}))"
    python = [str(league.with_name("python")), "-c", program]
    printed = subprocess.run(python, cwd=directory, env=ENVIRONMENT, check=True, capture_output=True, text=True)
    assert all(Path(file).is_relative_to(league.parent.parent) for file in printed.stdout.split())


def test_doctor(run: Installed) -> None:
    process = run("doctor")
    assert process.returncode == 0, process.stdout + process.stderr


@pytest.mark.e2e
def test_demo(run: Installed) -> None:
    """It trains a bundled configuration, evaluates and serves."""
    process = run("demo", "--minutes", "0.2", "--exit", "--port", str(free_ports(1)[0]))
    assert process.returncode == 0, process.stdout + process.stderr
    assert re.search(r"The champion (won|lost)\.|draw", process.stdout), process.stdout


@pytest.mark.parametrize("arguments", [("check-env", "two_step_game"), ("nightly", "cars_and_lights")], ids=" ".join)
def test_commands_with_the_environments_of_the_examples(run: Installed, arguments: tuple[str, ...]) -> None:
    process = run(*arguments)
    assert process.returncode == 0, process.stdout + process.stderr


def test_a_misspelled_name_lists_the_bundled_configurations(run: Installed) -> None:
    process = run("train", "conect_four")
    assert process.returncode == 2
    assert "connect_four, " in process.stderr


GAME = """
import sys
import numpy as np
from policy_league_client import Client

with Client(sys.argv[1]) as client, client.episode("tictactoe") as episode:
    board, mask = np.zeros((3, 3, 2), np.int8), np.ones(9, np.int8)
    for side in (0, 1, 0):
        action = episode.act({"observation": board, "action_mask": mask})
        board.reshape(9, 2)[action, side] = 1
        mask[action] = 0
    print(board.sum(), episode.version, *sorted({"league", "onnxruntime", "ray"} & set(sys.modules)))
"""


def test_the_image_of_the_server_evaluates_and_plays_and_the_client_alone_calls_it(
    server: Path, client: Path, tmp_path: Path
) -> None:
    registry = tictactoe.registry(tmp_path / "league-home")
    tictactoe.playable(registry)
    registry.close()
    absent = subprocess.run([server.with_name("python"), "-c", "import torch"], env=ENVIRONMENT, capture_output=True)
    assert absent.returncode == 1
    for command in (
        "nightly tictactoe",
        "evaluate tictactoe --blocks 4",
        "replay tictactoe@1 tictactoe@2 --out game.gif",
        "act tictactoe@1 --local",
    ):
        process = subprocess.run(
            [server, *command.split()], cwd=tmp_path, env=ENVIRONMENT, capture_output=True, text=True, timeout=600
        )
        assert process.returncode == 0, process.stdout + process.stderr
    with served(server, tmp_path) as url:
        for page in ("/", "/docs", "/openapi.json", "/v1/leagues"):
            assert httpx.get(url + page, follow_redirects=True).status_code == 200, page
        process = subprocess.run(
            [client, "-c", GAME, url], cwd=tmp_path, env=ENVIRONMENT, capture_output=True, text=True, timeout=120
        )
        assert process.stdout.split()[0] == "3", process.stderr
        assert len(process.stdout.split()) == 2


def test_policy_league_requires_what_the_client_requires() -> None:
    full, client = (tomllib.loads((ROOT / path / "pyproject.toml").read_text()) for path in (".", CLIENT))
    assert set(client["project"]["dependencies"]) <= set(full["project"]["dependencies"])


@contextmanager
def served(league: Path, directory: Path) -> Iterator[str]:
    """The URL of a server that the script has started in a directory."""
    port, grpc_port = free_ports(2)
    command = [str(league), "serve", "--port", str(port), "--grpc-port", str(grpc_port), "--replicas", "1"]
    url = f"http://127.0.0.1:{port}"
    with subprocess.Popen(command, cwd=directory, env=ENVIRONMENT, stdout=subprocess.PIPE, text=True) as server:
        try:
            _await_ready(server, url)
            yield url
        finally:
            server.send_signal(signal.SIGINT)
        assert server.wait(60) == 0


def _await_ready(server: subprocess.Popen[str], url: str, timeout: float = 180) -> None:
    def is_ready() -> bool:
        assert server.poll() is None, f"the server has ended with exit code {server.poll()}"
        try:
            return httpx.get(f"{url}/v1/health/ready").status_code == 200
        except httpx.TransportError:
            return False

    until(is_ready, timeout)
