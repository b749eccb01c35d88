"""`make test` is red for faults: only a test that passes alone, in a new process, is forgiven."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PRELUDE = """
import os, signal, time
from pathlib import Path

import pytest

def die():
    os.kill(os.getpid(), signal.SIGKILL)

def is_first_time(path=Path("was here")):
    if is_first := not path.exists():
        path.touch()
    return is_first
"""
PASSING = "def test_passes(): pass"


def run(directory: Path, files: dict[str, str], *options: str, seconds: int = 300) -> subprocess.CompletedProcess[str]:
    """Run the tests of some files, without their prelude and by the names of modules, as `make test` does."""
    (directory / "pytest.ini").touch()
    for name, text in files.items():
        (directory / f"{name}.py").write_text(PRELUDE + text)
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST")}
    environment |= {"PYTHONPATH": str(ROOT), "PYTEST_PLUGINS": "xdist.plugin,tests.support.distribution"}
    environment |= {"PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}  # others take a second to import
    command = [sys.executable, ROOT / "scripts" / "run_tests.py", "name", str(seconds), "-n2", "--dist=loadscope"]
    return subprocess.run([*command, *options], cwd=directory, env=environment, capture_output=True, text=True)


def test_a_test_that_passes_alone_is_flaky(tmp_path: Path) -> None:
    row = "    with subtests.test(row=1): assert not is_first_time(), 'the first time'"
    files = {"test_a": f"def test_it(subtests):\n{row}", "test_b": PASSING}
    process = run(tmp_path, files)
    assert process.returncode == 0, process.stdout
    assert process.stdout.splitlines()[-2:] == ["FLAKY test_a.py::test_it", "    AssertionError: the first time"]
    assert (tmp_path / "build" / "gate" / "name.xml").exists()


@pytest.mark.slow
def test_a_process_that_is_killed_fails_one_test_and_all_others_run(tmp_path: Path) -> None:
    several = "@pytest.mark.parametrize('text', [*'abcd', 'a/b.py::c[d]', *'ghij'])\n"
    fatal = "def test_it(text): '::' in text and is_first_time() and die()"
    names = [f"test_{number}" for number in range(8)]
    process = run(tmp_path, dict.fromkeys(names, several + "def test_it(text): pass") | {"test_4": several + fatal})
    assert process.returncode == 0, process.stdout
    assert "1 failed, 71 passed" in process.stdout
    flaky, message = process.stdout.splitlines()[-2:]
    assert flaky == "FLAKY test_4.py::test_it[a/b.py::c[d]]"
    assert "crashed while running" in message


SESSION_FIXTURE = "@pytest.fixture(autouse=True, scope='session')\ndef never(): assert False"
IN_ONE_OF_MANY_FILES = "def test_it(): assert not is_first_time(Path(__file__ + ' was here'))"


FAULTS: dict[str, tuple[dict[str, str], str]] = {
    "a falsehood": ({"test_a": "def test_it(): assert 1 == 2"}, "BROKEN test_a.py::test_it"),
    "skipped alone": (
        {"test_a": "def test_it():\n    is_first_time() or pytest.skip()\n    assert False"},
        "BROKEN test_a.py::test_it",
    ),
    "a killed process, always": ({"test_a": "def test_it(): die()"}, "BROKEN test_a.py::test_it"),
    "a fixture": ({"conftest": SESSION_FIXTURE, "test_a": PASSING}, "BROKEN test_a.py::test_passes"),
    "a file that cannot be imported": ({"test_a": "import no_such_module", "test_b": PASSING}, ""),
    "many files": (
        {f"test_{letter}": IN_ONE_OF_MANY_FILES for letter in "abcd"},
        "nothing is repeated: 4 failed in 4 files",
    ),
    "processes that die when they start": (
        {"conftest": "def pytest_configure(config): hasattr(config, 'workerinput') and die()", "test_a": PASSING},
        "",
    ),
    "no test": ({"test_a": ""}, ""),
}
"""Name → files, and a part of the output."""


@pytest.mark.parametrize(
    "name", ["a falsehood", *(pytest.param(name, marks=pytest.mark.slow) for name in [*FAULTS][1:])]
)
def test_a_fault_is_red(tmp_path: Path, name: str) -> None:
    files, part = FAULTS[name]
    process = run(tmp_path, files)
    assert process.returncode != 0, process.stdout
    assert part in process.stdout
    assert "FLAKY" not in process.stdout


@pytest.mark.slow
def test_a_run_that_leaves_tests_out_is_red(tmp_path: Path) -> None:
    process = run(tmp_path, {"test_a": IN_ONE_OF_MANY_FILES, "test_b": "def test_it(): time.sleep(1)"}, "--maxfail=1")
    assert process.returncode > 1, process.stdout
    assert "FLAKY" not in process.stdout


@pytest.mark.slow
def test_a_run_that_does_not_end_is_stopped(tmp_path: Path) -> None:
    process = run(tmp_path, {"test_a": "def test_it(): time.sleep(600)"}, seconds=4)
    assert process.returncode == 124
    assert process.stdout.splitlines()[-1] == "stopped after 4 s"
