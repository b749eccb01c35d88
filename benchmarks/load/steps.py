"""Requests at a rate that changes in steps, and next to them the calls of our client.

`python -m benchmarks.load.steps URL` reads a rate in requests per second from each line of its standard input, answers
each line when the rate has changed, and prints a line of JSON (a `Steps`) at its end. The requests are single attempts
over open connections; our client repeats failed ones. Both wait for their turn, not for answers: a slow server gets no
fewer.
"""

import asyncio
import json
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path

from benchmarks.leagues.served_league import BODY, LEAGUE, PLANES
from benchmarks.load.http import drive
from league.client import AsyncClient
from league.errors import LeagueError

ROOT = Path(__file__).parents[2]
CONNECTIONS = 16
CLIENTS, INTERVAL = 4, 0.4
"""Calls of our client, and seconds between two calls of each."""
OBSERVATION = {"observation": PLANES, "action_mask": [1] * 7}


@dataclass
class Steps:
    """What callers saw.

    calls, lost: of our client, and its errors. attempts: requests without repetition; statuses: those other than 200
    → count, 0 for a dropped connection. longest: duration of the longest call in seconds. replicas: replica → first and
    last answer, times of `time.monotonic`.
    """

    calls: int = 0
    lost: list[str] = field(default_factory=list)
    attempts: int = 0
    statuses: dict[str, int] = field(default_factory=dict)
    longest: float = 0.0
    replicas: dict[str, tuple[float, float]] = field(default_factory=dict)

    def since(self, start: float) -> list[float]:
        """Seconds from `start` to the first answer of each replica that answered first after it."""
        return sorted(first - start for first, _ in self.replicas.values() if first > start)


class StepLoad:
    """A running load."""

    def __init__(self, process: "subprocess.Popen[str]") -> None:
        self._process = process
        self.seen = Steps()
        """Available after the load has ended."""

    def set_rate(self, rate: float) -> None:
        """Change the rate, in requests per second."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(f"{rate}\n")
        self._process.stdin.flush()
        self._process.stdout.readline()


@contextmanager
def stepping(url: str) -> Iterator[StepLoad]:
    """A load on the server at `url` while the context lasts, at first without requests but those of our client."""
    command = [sys.executable, "-m", "benchmarks.load.steps", url]
    with subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        load = StepLoad(process)
        try:
            load.set_rate(0)
            yield load
        finally:
            output, _ = process.communicate()
        load.seen = Steps(**json.loads(output))


class _Load:
    def __init__(self, url: str) -> None:
        self.seen = Steps()
        self._url = url
        self._step = 0
        self._is_over = False

    async def run(self) -> None:
        """Follow the rates of standard input until it ends."""
        loop, requests = asyncio.get_running_loop(), list[asyncio.Task[None]]()
        clients = [asyncio.create_task(self._call()) for _ in range(CLIENTS)]
        while line := await loop.run_in_executor(None, sys.stdin.readline):
            self._step += 1
            if rate := float(line):
                requests.append(asyncio.create_task(self._request(rate, self._step)))
            print("changed", flush=True)
        self._step += 1
        self._is_over = True
        await asyncio.gather(*requests, *clients)

    async def _request(self, rate: float, step: int) -> None:
        def on_reply(status: int, _: bytes, __: float) -> bool:
            self.seen.attempts += 1
            if status != 200:
                self.seen.statuses[str(status)] = self.seen.statuses.get(str(status), 0) + 1
            return self._step == step

        url = f"{self._url}/v1/policies/{LEAGUE}/action"
        await drive(url, BODY, CONNECTIONS, on_reply, lambda: self._step == step, rate=rate)

    async def _call(self) -> None:
        async with AsyncClient(self._url) as client:
            while not self._is_over:
                start = time.monotonic()
                try:
                    response = await client.act(LEAGUE, OBSERVATION)
                except LeagueError as error:
                    self.seen.lost.append(f"{type(error).__name__}: {str(error)[:120]}")
                else:
                    now = time.monotonic()
                    first, _ = self.seen.replicas.get(response.replica, (now, now))
                    self.seen.replicas[response.replica] = first, now
                    self.seen.longest = max(self.seen.longest, now - start)
                self.seen.calls += 1
                await asyncio.sleep(max(0.0, start + INTERVAL - time.monotonic()))


def main() -> None:
    """Follow standard input."""
    import uvloop

    load = _Load(sys.argv[1])
    uvloop.run(load.run())
    print(json.dumps(asdict(load.seen)))


if __name__ == "__main__":
    main()
