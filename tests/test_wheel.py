"""The wheel is complete: each command works with only the wheel installed, in an empty directory."""

import os
import re
import signal
import subprocess
import sys
import sysconfig
import zipfile
from collections.abc import Callable
from pathlib import Path

import httpx
import pytest

from serve_app.runtime.haproxy import free_ports
from tests.support.waiting import until

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1200)]

ROOT = Path(__file__).parent.parent
PACKAGES = ("evaluation", "league", "policy_league", "serve_app", "training")

Installed = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel as built by `python -m build` from the source distribution."""
    directory = tmp_path_factory.mktemp("dist")
    build = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(directory), str(ROOT)]
    subprocess.run(build, check=True, capture_output=True, timeout=300)
    (built,) = directory.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def league(wheel: Path, environment: dict[str, str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The `league` script of a new virtual environment with the wheel and the dependencies installed here."""
    directory = tmp_path_factory.mktemp("environment")
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(directory)], check=True)
    python = directory / "bin" / "python"
    pip = [sys.executable, "-m", "pip", "--python", str(python), "install", "--quiet", "--no-deps", "--no-index"]
    subprocess.run([*pip, str(wheel)], env=environment, check=True, timeout=120)
    # Modules are found in the directory, but its .pth files are not read: an editable installation has no effect.
    (packages,) = directory.glob("lib/*/site-packages")
    (packages / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return directory / "bin" / "league"


@pytest.fixture(scope="module")
def directory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("empty")


@pytest.fixture(scope="module")
def environment() -> dict[str, str]:
    clean = {name: value for name, value in os.environ.items() if not name.startswith(("LEAGUE_", "PYTHON"))}
    return clean | {"COLUMNS": "200", "NO_COLOR": "1"}


@pytest.fixture
def run(league: Path, directory: Path, environment: dict[str, str]) -> Installed:
    def command(*arguments: str, timeout: float = 600) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [str(league), *arguments], cwd=directory, env=environment, capture_output=True, text=True, timeout=timeout
        )

    return command


def test_the_wheel_contains_all_tracked_files_of_the_packages(wheel: Path) -> None:
    listed = subprocess.run(["git", "ls-files", *PACKAGES], cwd=ROOT, check=True, capture_output=True, text=True)
    with zipfile.ZipFile(wheel) as archive:
        assert set(listed.stdout.splitlines()) - set(archive.namelist()) == set()
        assert archive.read("serve_app/deploy.yaml") == (ROOT / "deploy.yaml").read_bytes()
        (top_level,) = [name for name in archive.namelist() if name.endswith("top_level.txt")]
        assert tuple(archive.read(top_level).decode().split()) == PACKAGES


def test_modules_come_from_the_wheel(league: Path, directory: Path, environment: dict[str, str]) -> None:
    program = f"import importlib; print(*(importlib.import_module(name).__file__ for name in {PACKAGES}))"
    python = [str(league.with_name("python")), "-c", program]
    found = subprocess.run(python, cwd=directory, env=environment, check=True, capture_output=True, text=True)
    assert all(Path(file).is_relative_to(league.parent.parent) for file in found.stdout.split())


def test_doctor(run: Installed) -> None:
    process = run("doctor")
    assert process.returncode == 0, process.stdout + process.stderr


def test_demo(run: Installed) -> None:
    process = run("demo", "--minutes", "0.2", "--exit", "--port", str(free_ports(1)[0]))
    assert process.returncode == 0, process.stdout + process.stderr
    assert re.search(r"The champion (won|lost)\.|draw", process.stdout), process.stdout


def test_train_by_name(run: Installed) -> None:
    process = run("train", "connect_four", "--minutes", "0.1", "--runners", "0")
    assert process.returncode == 0, process.stdout + process.stderr
    assert "Published connect_four@" in process.stdout


@pytest.mark.parametrize("arguments", [("check-env", "two_step_game"), ("nightly", "cars_and_lights")], ids=" ".join)
def test_other_commands_with_the_environments_of_the_examples(run: Installed, arguments: tuple[str, ...]) -> None:
    process = run(*arguments)
    assert process.returncode == 0, process.stdout + process.stderr


def test_a_misspelled_name_lists_the_bundled_configurations(run: Installed) -> None:
    process = run("train", "conect_four")
    assert process.returncode == 2
    assert "connect_four, " in process.stderr


def test_serve(league: Path, directory: Path, environment: dict[str, str]) -> None:
    port, grpc_port = free_ports(2)
    command = [str(league), "serve", "--port", str(port), "--grpc-port", str(grpc_port), "--replicas", "1"]
    url = f"http://127.0.0.1:{port}"
    with subprocess.Popen(command, cwd=directory, env=environment, stdout=subprocess.PIPE, text=True) as server:
        try:
            _await_ready(server, url)
            for page in ("/", "/docs", "/openapi.json", "/v1/leagues"):
                assert httpx.get(url + page, follow_redirects=True).status_code == 200, page
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
