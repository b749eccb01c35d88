"""How long does it take from a machine with only Python to a promoted endpoint that answers?

Clones the committed state, runs `make demo` in the clone without pip's cache, and requests actions from the endpoint
until it answers. Target: 10 minutes, of which training takes at most 5. Then plays the resulting champion against the
scripts (`benchmarks.strength`).
"""

import os
import signal
import subprocess
import tempfile
import threading
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import httpx

from benchmarks.harness import ROOT, Quick, Target

TARGET = 600.0
TRAINING_TARGET = 300.0
OBSERVATION = {"observation": [[[0, 0]] * 7] * 6, "action_mask": [1] * 7}
PHASES = (
    ("set-up", "Policy League demo"),
    ("training", "Step 2"),
    ("league", "Step 3"),
    ("serving", "Step 4"),
)
"""The phase that has ended when a line with this text appears."""


def main(quick: Quick = False, port: int = 8000) -> Iterator[Target]:
    """Time each phase."""
    with tempfile.TemporaryDirectory(prefix="policy-league-") as folder:
        clone = Path(folder) / "policy-league"
        subprocess.run(["git", "clone", "--quiet", str(ROOT), str(clone)], check=True)
        arguments = f"--exit --port {port}" + (" --minutes 0.5" if quick else "")
        marks, answered = _run(clone, arguments, f"http://127.0.0.1:{port}")
        print("\nthe champion of this demo:", flush=True)
        strength = [".venv/bin/python", "-m", "benchmarks", "strength", "--hold", "demo"]
        subprocess.run(strength, cwd=clone, env=_environment(clone))
    for before, phase in pairwise(("start", *(phase for phase, _ in PHASES if phase in marks))):
        limit = TRAINING_TARGET if phase == "training" else None
        yield Target(phase, round(marks[phase] - marks.get(before, 0.0), 1), "s", at_most=limit)
    yield Target("promoted endpoint answers", round(answered, 1), "s", at_most=TARGET)


def _run(clone: Path, arguments: str, url: str) -> tuple[dict[str, float], float]:
    start = time.perf_counter()
    demo = subprocess.Popen(
        ["make", "demo", f"DEMO={arguments}"],
        cwd=clone,
        env=_environment(clone),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
    marks: dict[str, float] = {}
    reader = threading.Thread(target=_read, args=(demo, start, marks))
    reader.start()
    try:
        answered = _answer(url, start, demo)
        demo.wait(120)
        return marks, answered
    finally:
        if demo.poll() is None:
            os.killpg(demo.pid, signal.SIGINT)
            demo.wait()
        reader.join()


def _environment(clone: Path) -> dict[str, str]:
    return os.environ | {"PIP_NO_CACHE_DIR": "1", "LEAGUE_HOME": str(clone / "league-home")}


def _read(demo: "subprocess.Popen[str]", start: float, marks: dict[str, float]) -> None:
    assert demo.stdout is not None
    for line in demo.stdout:
        print("   |", line.rstrip(), flush=True)
        for phase, text in PHASES:
            if text in line and phase not in marks:
                marks[phase] = time.perf_counter() - start


def _answer(url: str, start: float, demo: "subprocess.Popen[str]") -> float:
    """Seconds from `start` until the champion answers. Raises RuntimeError if the demo ends before."""
    while demo.poll() is None:
        try:
            reply = httpx.post(f"{url}/v1/policies/connect_four/action", json={"observation": OBSERVATION})
            if reply.status_code == 200:
                return time.perf_counter() - start
        except httpx.HTTPError:
            pass
        time.sleep(0.5)
    raise RuntimeError("the demo ended before the champion answered")
