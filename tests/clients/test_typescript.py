"""The TypeScript client: its types are those of the API, its package works, and it loses no call."""

import json
import os
import re
import shutil
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from league.settings import Storage
from scripts.generate_typescript import PACKAGE, TARGET, generate
from serve_app.runtime.launch import running
from tests.support.leagues.served_leagues import everything
from tests.support.servers.streaming import connect_four_server
from tests.support.servers.under_load import NO_SHEDDING, deploy_file, processes
from tests.support.waiting import until

pytestmark = pytest.mark.slow  # installs packages, and kills replicas

ROOT = Path(__file__).parents[2]
NODE = ("node", "--experimental-websocket")  # a default of Node.js 22
MODULES = {
    "index",
    "binary",
    "client",
    "episode",
    "errors",
    "openapi",
    "references",
    "requests",
    "responses",
    "retries",
}
MODULES |= {"seeds", "simulator", "stream", "web_socket"}


def run(directory: Path, *command: str) -> str:
    """The output of a program that succeeds."""
    process = subprocess.run(command, cwd=directory, capture_output=True, text=True)
    assert process.returncode == 0, f"{' '.join(command)}:\n{process.stdout}\n{process.stderr}"
    return process.stdout


@pytest.fixture(scope="module")
def package() -> Path:
    """The package with its development dependencies, compiled."""
    if shutil.which("npm") is None:
        missing = "npm is not installed: the TypeScript client needs Node.js 20"
        (pytest.fail if os.environ.get("CI") else pytest.skip)(missing)
    installation = subprocess.run(["npm", "ci", "--no-audit", "--no-fund"], cwd=PACKAGE, capture_output=True, text=True)
    if installation.returncode:
        pytest.fail(f"`npm ci` in {PACKAGE.relative_to(ROOT)} failed; it needs npm's registry:\n{installation.stderr}")
    run(PACKAGE, "npm", "run", "build")
    return PACKAGE


@pytest.fixture(scope="module")
def project(package: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project that has installed the packed package."""
    directory = tmp_path_factory.mktemp("project")
    (archive,) = json.loads(run(package, "npm", "pack", "--json", "--pack-destination", str(directory)))
    extensions = (".js", ".d.ts")
    files = {f"dist/src/{module}{extension}" for module in MODULES for extension in extensions}
    assert {file["path"] for file in archive["files"]} == {"LICENSE", "README.md", "package.json", *files}
    (directory / "package.json").write_text('{"type": "module"}')
    run(directory, "npm", "install", "--offline", "--no-audit", "--no-fund", archive["filename"])
    return directory


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with connect_four_server(tmp_path_factory.mktemp("shown")) as server:
        yield server


def test_the_types_are_those_of_the_api(package: Path) -> None:
    assert TARGET.read_text() == generate(), "run `make generate`"


def test_the_tests_of_the_package_pass(package: Path) -> None:
    run(package, "npm", "test")


def test_pasted_programs_run(project: Path, url: str) -> None:
    compiler = [str(PACKAGE / "node_modules/.bin/tsc"), "--strict", "--target", "es2022", "--module", "nodenext"]
    types = ["--typeRoots", str(PACKAGE / "node_modules/@types"), "--types", "node"]
    example = (PACKAGE / "examples/play.ts").read_text()
    assert example.partition("\n\n")[2] in (PACKAGE / "README.md").read_text()
    programs = {"example": example}
    programs["page"] = "\n".join(
        re.findall(r"^```ts\n(.*?)^```", (ROOT / "docs/typescript.md").read_text(), re.S | re.M)
    )
    for name, text in programs.items():
        (project / f"{name}.ts").write_text(text.replace("http://127.0.0.1:8000", url))
        run(project, *compiler, *types, f"{name}.ts")
        output = run(project, *NODE, f"{name}.js")
        assert len(output.splitlines()) >= text.count("console.log")


def test_no_call_is_lost_when_replicas_die(package: Path, tmp_path: Path) -> None:
    storage = Storage.at(tmp_path / "home")
    everything(storage).close()
    with running(storage, replicas=2, insecure=True, deploy=deploy_file(tmp_path, NO_SHEDDING)) as url:
        program = [*NODE, "dist/test/under_load.js", url]
        pipe = subprocess.PIPE
        with subprocess.Popen(program, cwd=package, stdin=pipe, stdout=pipe, text=True) as process:
            assert process.stdin is not None
            assert process.stdout is not None
            for _ in range(2):
                replicas = set(processes(storage, "PolicyServer"))
                for _ in range(3):
                    assert process.stdout.readline()
                victim = min(replicas)
                os.kill(victim, signal.SIGKILL)
                for _ in range(10):
                    assert process.stdout.readline()
                until(lambda victim=victim: len(set(processes(storage, "PolicyServer")) - {victim}) == 2)
            process.stdin.close()
            result = json.loads(process.stdout.read().splitlines()[-1])
    assert result["failures"] == []
    assert all(count > 100 for count in result["actions"].values()), result
