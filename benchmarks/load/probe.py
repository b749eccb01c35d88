"""How long does a server keep a caller waiting? Requests on new connections at a steady rate, without waiting for the
responses of earlier ones.
"""

import asyncio
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from urllib.parse import urlsplit

from benchmarks.load.elsewhere import run_elsewhere
from benchmarks.load.http import JSON, post

INTERVAL = 0.02
"""Seconds between two requests."""
TIMEOUT = 30.0
"""Seconds after which a request counts as unanswered."""


@dataclass(frozen=True, slots=True)
class Probe:
    """The results of one run.

    longest: seconds from the time at which a request was due to its response, or to the end of its connection;
    statuses: responses by status, `0` for dropped connections and unanswered requests.
    """

    longest: float
    statuses: dict[str, int]


async def run(url: str, body: bytes, seconds: float, headers: Mapping[str, str]) -> Probe:
    """Send requests for some seconds, and wait for all responses."""
    parts = urlsplit(url)
    request = post(url, body, {**headers, "Connection": "close"})
    statuses: Counter[str] = Counter()
    longest = 0.0

    async def ask(due: float) -> None:
        nonlocal longest
        status = "0"
        try:
            async with asyncio.timeout(TIMEOUT):
                reader, writer = await asyncio.open_connection(parts.hostname, parts.port)
                writer.write(request)
                reply = await reader.read()
                writer.close()
            status = reply[9:12].decode() or "0"
        except (OSError, TimeoutError):
            pass
        statuses[status] += 1
        longest = max(longest, time.perf_counter() - due)

    async with asyncio.TaskGroup() as group:
        start = time.perf_counter()
        for number in range(int(seconds / INTERVAL)):
            due = start + number * INTERVAL
            await asyncio.sleep(due - time.perf_counter())
            group.create_task(ask(due))
    return Probe(longest, dict(statuses))


def measure(url: str, body: bytes, seconds: float, headers: Mapping[str, str] = JSON) -> Probe:
    """Run the probe in a process of its own."""
    return run_elsewhere(run, url, body, seconds, dict(headers))
