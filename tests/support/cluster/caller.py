"""Calls a served policy without pause, with and without the client's retries, and reports what was lost.

Starts when the server answers, runs until SIGTERM, and keeps a JSON file up to date. Arguments: base URL, API key,
league, number of threads, file.
"""

import json
import signal
import sys
import threading
import time
from pathlib import Path
from typing import Any

import httpx
import numpy as np

from league.errors import LeagueError
from league.files import replacing
from policy_league_client import Client

BOARD = {"observation": np.zeros((3, 3, 2), np.int8), "action_mask": np.ones(9, np.int8)}
BODY = {"observation": {name: value.tolist() for name, value in BOARD.items()}}
TIMEOUT = 5.0


class Caller:
    """Counts of calls by the client, and of single attempts; the versions and replicas that answered, when first and
    last."""

    def __init__(self, url: str, key: str, league: str, file: Path) -> None:
        self.url, self.key, self.league, self.file = url, key, league, file
        self.stop = threading.Event()
        self.report: dict[str, Any] = {"calls": 0, "lost": [], "attempts": 0, "attempts_lost": [], "longest": 0.0}
        self.report |= {"attempts_shed": [], "versions": {}, "replicas": {}}
        self._lock = threading.Lock()

    def wait_until_ready(self) -> None:
        """Wait for the first answer: HAProxy may start later on this node than on the others."""
        with httpx.Client(timeout=TIMEOUT, trust_env=False) as client:
            while not self.stop.wait(0.05):
                try:
                    if client.get(f"{self.url}/v1/health/ready").status_code == 200:
                        return
                except httpx.TransportError:
                    continue

    def call(self) -> None:
        """Calls of the client, which tries again."""
        with Client(self.url, key=self.key, retry_deadline=60) as client:
            while not self.stop.is_set():
                began, failure, version = time.time(), None, None
                try:
                    version = client.act(self.league, BOARD).version
                except LeagueError as error:
                    failure = f"{began:.3f} {error}"
                self._count("calls", "lost", failure)
                with self._lock:
                    self.report["longest"] = max(self.report["longest"], time.time() - began)
                if version is not None:
                    self._answered("versions", str(version))

    def attempt(self) -> None:
        """Single attempts."""
        path, headers = f"{self.url}/v1/policies/{self.league}/action", {"x-api-key": self.key}
        with httpx.Client(timeout=TIMEOUT, headers=headers, trust_env=False) as client:
            while not self.stop.is_set():
                began, failure, kind = time.time(), None, "attempts_lost"
                try:
                    response = client.post(path, json=BODY)
                    if response.status_code == 429:
                        kind = "attempts_shed"
                    if response.status_code != 200:
                        failure = f"{began:.3f} {response.status_code} {response.text[:200]}"
                except httpx.TransportError as error:
                    failure = f"{began:.3f} {error!r}"
                self._count("attempts", kind, failure)

    def watch(self) -> None:
        """Which replicas answer."""
        with httpx.Client(timeout=TIMEOUT, trust_env=False) as client:
            while not self.stop.wait(0.05):
                try:
                    response = client.get(f"{self.url}/v1/health/ready", headers={"connection": "close"})
                except httpx.TransportError:
                    continue
                if response.status_code == 200:
                    self._answered("replicas", response.json()["replica"])
                self.write()

    def write(self) -> None:
        """Write the report to the file."""
        with self._lock, replacing(self.file) as draft:
            draft.write_text(json.dumps(self.report))

    def _answered(self, kind: str, name: str) -> None:
        with self._lock:
            moment = time.time()
            self.report[kind].setdefault(name, [moment, moment])[1] = moment

    def _count(self, kind: str, lost: str, failure: str | None) -> None:
        with self._lock:
            self.report[kind] += 1
            if failure is not None:
                self.report[lost].append(failure)


def main() -> None:
    """Run the threads until SIGTERM."""
    url, key, league, threads, file = sys.argv[1:]
    caller = Caller(url, key, league, Path(file))
    signal.signal(signal.SIGTERM, lambda *_: caller.stop.set())
    caller.wait_until_ready()
    running = [
        threading.Thread(target=target)
        for target in (*[caller.call] * int(threads), *[caller.attempt] * int(threads), caller.watch)
    ]
    for thread in running:
        thread.start()
    for thread in running:
        thread.join()
    caller.write()


if __name__ == "__main__":
    main()
