"""The calls of clients during faults: half of them with our client, half with a client without retries.

`python -m benchmarks.load.callers URL FILE` requests actions until standard input is closed, then writes the results of
all calls to FILE (an array, see `CallLog`). It is a separate process, so that fault injection does not affect the
measurement.
"""

import asyncio
import json
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.leagues.served_league import BODY, LEAGUE, PLANES
from benchmarks.load.http import drive
from league.client import AsyncClient
from league.errors import LeagueError

ROOT = Path(__file__).parents[2]
CALLERS = 4
"""Callers of each kind. Each calls again as soon as it has an answer."""
WITH_RETRIES, WITHOUT_RETRIES = 0.0, 1.0
"""The kinds of clients: ours, which retries, and one that does not."""


@dataclass
class CallLog:
    """The calls of one run.

    calls: (n, 4): kind, start and end by `time.perf_counter`; 1 if it was answered, else 0. errors: exceptions of our
    client → count. Both are available after the callers have stopped.
    """

    calls: NDArray = field(default_factory=lambda: np.zeros((0, 4)))
    errors: dict[str, int] = field(default_factory=dict)

    def failed(self, kind: float) -> NDArray:
        """The end times of the failed calls of a kind."""
        times: NDArray = self.calls[(self.calls[:, 0] == kind) & (self.calls[:, 3] == 0), 2]
        return times

    def p99(self, kind: float) -> float:
        """99th percentile of the duration of answered calls in milliseconds, including retries and delays."""
        answered = self.calls[(self.calls[:, 0] == kind) & (self.calls[:, 3] == 1)]
        return float(np.percentile(answered[:, 2] - answered[:, 1], 99) * 1e3) if len(answered) else float("nan")


@contextmanager
def calling(url: str, scratch: Path) -> Iterator[CallLog]:
    """Call in a subprocess while the context lasts, which starts with the first answer."""
    file = scratch / "calls.npy"
    command = [sys.executable, "-m", "benchmarks.load.callers", url, str(file)]
    seen = CallLog()
    with subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as callers:
        assert callers.stdin is not None
        assert callers.stdout is not None
        callers.stdout.readline()
        try:
            yield seen
        finally:
            callers.stdin.close()
            output = callers.stdout.read()
    seen.calls, seen.errors = np.load(file), json.loads(output)


def main() -> None:
    """Call until standard input is closed."""
    import uvloop

    url, file = sys.argv[1:]
    stop = threading.Event()
    threading.Thread(target=lambda: (sys.stdin.read(), stop.set()), daemon=True).start()
    calls, errors = uvloop.run(_call(url, stop))
    np.save(file, np.array(calls))
    print(json.dumps(errors))


async def _call(url: str, stop: threading.Event) -> tuple[list[tuple[float, ...]], Counter[str]]:
    calls: list[tuple[float, ...]] = []
    errors: Counter[str] = Counter()
    observation = {"observation": PLANES, "action_mask": np.ones(7, np.int8)}

    def record(kind: float, sent_at: float, is_answered: bool) -> None:
        if not calls:
            print("answered", flush=True)
        calls.append((kind, sent_at, time.perf_counter(), float(is_answered)))

    def on_reply(status: int, _: bytes, sent_at: float) -> bool:
        record(WITHOUT_RETRIES, sent_at, status == 200)
        return not stop.is_set()

    async def call_with_retries() -> None:
        async with AsyncClient(url) as client:
            while not stop.is_set():
                sent_at = time.perf_counter()
                try:
                    await client.act(LEAGUE, observation)
                except LeagueError as error:
                    errors[f"{type(error).__name__}: {str(error)[:120]}"] += 1
                    record(WITH_RETRIES, sent_at, False)
                else:
                    record(WITH_RETRIES, sent_at, True)

    once = drive(f"{url}/v1/policies/{LEAGUE}/action", BODY, CALLERS, on_reply, lambda: not stop.is_set())
    await asyncio.gather(once, *(call_with_retries() for _ in range(CALLERS)))
    return calls, errors


if __name__ == "__main__":
    main()
