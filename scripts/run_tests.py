"""Run pytest, then each test that failed once more: alone, in a new process. Tests that pass there are flaky.

Usage: python scripts/run_tests.py NAME SECONDS ARGUMENT…

The run succeeds if all tests passed or are flaky, which its last lines name. Nothing is repeated after a run that did
not end by itself, left tests out or could not collect a file, nor if so much failed that chance cannot be the reason.

NAME: of the results, build/gate/NAME.xml. SECONDS: after which the run is stopped. ARGUMENT: of pytest.
"""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from xml.etree import ElementTree

MAX_TESTS, MAX_FILES = 20, 3
"""More failures are not repeated."""
REPEATING = 600
"""Seconds for all that is repeated."""
TIMED_OUT = 124
"""Exit code of a run that was stopped, as that of `timeout`."""


def pytest(seconds: float, *arguments: str) -> int:
    """Run pytest in a process group of its own, and return its exit code. Nothing of the group outlives this call."""
    run = subprocess.Popen([sys.executable, "-m", "pytest", *arguments], start_new_session=True)
    try:
        return run.wait(max(1, seconds))
    except subprocess.TimeoutExpired:
        return TIMED_OUT
    finally:
        if run.poll() is None:  # out of time, Ctrl-C or SIGTERM
            os.killpg(run.pid, signal.SIGINT)
            with suppress(subprocess.TimeoutExpired):
                run.wait(30)
        with suppress(ProcessLookupError):
            os.killpg(run.pid, signal.SIGKILL)
        run.wait()


def first_lines(report: Path) -> dict[str, str]:
    """Return the first line of the first error of each test, by its dotted name. Subtests fail before their test."""
    return {
        f"{case.get('classname')}.{case.get('name')}": problem.get("message", "").partition("\n")[0]
        for case in reversed(list(ElementTree.parse(report).iter("testcase")))
        for problem in reversed([*case.findall("error"), *case.findall("failure")])
    }


def dotted(test: str) -> str:
    function, bracket, parameters = test.partition("[")
    return function.replace(".py::", ".").replace("::", ".").replace("/", ".") + bracket + parameters


def passes_alone(test: str, report: Path, seconds: float) -> bool:
    code = pytest(seconds, "-q", "-n0", "-p", "no:cacheprovider", f"--junitxml={report}", test)
    if code != 0:
        return False
    suites = ElementTree.parse(report).getroot().findall("testsuite")
    return sum(int(suite.get("tests", 0)) - int(suite.get("skipped", 0)) for suite in suites) > 0


def main(name: str, seconds: str, *arguments: str) -> int:
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    # A shell lets commands in the background ignore it, and pytest would inherit that.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    directory = Path("build/gate")
    cache, report = directory / name, directory / f"{name}.xml"
    shutil.rmtree(cache, ignore_errors=True)
    code = pytest(float(seconds), *arguments, "-o", f"cache_dir={cache}", f"--junitxml={report}")
    if code == TIMED_OUT:
        print(f"\nstopped after {seconds} s")
    if code != 1:
        return code
    last_failed = cache / "v" / "cache" / "lastfailed"
    failed = list(json.loads(last_failed.read_text())) if last_failed.exists() else []
    files = {test.partition("::")[0] for test in failed}
    if not failed or len(failed) > MAX_TESTS or len(files) > MAX_FILES or files & set(failed):
        print(f"nothing is repeated: {len(failed)} failed in {len(files)} files")
        return code
    end = time.monotonic() + REPEATING
    is_flaky = {test: passes_alone(test, directory / "repeated.xml", end - time.monotonic()) for test in failed}
    messages = first_lines(report)
    for test in failed:
        print("FLAKY" if is_flaky[test] else "BROKEN", test)
        print("   ", messages.get(dotted(test), "no message"))
    return 0 if all(is_flaky.values()) else code


if __name__ == "__main__":
    try:
        sys.exit(main(*sys.argv[1:]))
    except KeyboardInterrupt:
        sys.exit(130)
