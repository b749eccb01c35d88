"""How long does it take from a machine with only Python to a promoted endpoint that answers?

Clones the committed state, runs `make demo` in the clone without pip's cache, and requests actions from the endpoint
until it answers. Target: 10 minutes, of which training takes at most 5. Then plays the resulting champion against the
scripts (`benchmarks.strength`).
"""

import argparse
import os
import signal
import subprocess
import tempfile
import threading
import time
from pathlib import Path

import httpx

ROOT = Path(__file__).parent.parent
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


def main() -> None:
    """Print the seconds of each phase, and the total as a fraction of the target."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--port", type=int, default=8000)
    parser.add_argument("--quick", action="store_true", help="smoke test: half a minute of training")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="policy-league-") as folder:
        clone = Path(folder) / "policy-league"
        subprocess.run(["git", "clone", "--quiet", str(ROOT), str(clone)], check=True)
        arguments = f"--exit --port {options.port}" + (" --minutes 0.5" if options.quick else "")
        print("fresh clone, then: make demo", flush=True)
        marks, answered = _run(clone, arguments, f"http://127.0.0.1:{options.port}")
        print("\nthe champion of this demo:", flush=True)
        strength = [".venv/bin/python", "-m", "benchmarks.strength", "--hold", "demo"]
        subprocess.run(strength, cwd=clone, env=_environment(clone))
        print()
    previous = 0.0
    for phase, _ in PHASES:
        if phase in marks:
            print(f"{phase:>10}: {marks[phase] - previous:6.1f} s")
            previous = marks[phase]
    training = marks["training"] - marks["set-up"]
    print(f"training / 300 s: {training / TRAINING_TARGET:.2f}   (at most 1)")
    print(f"promoted endpoint answers after {answered:.1f} s; / 600 s: {answered / TARGET:.2f}   (at most 1)")


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


if __name__ == "__main__":
    main()
