"""Requests that arrive at four times the capacity of the server, at a fixed rate.

Four times the clients of the capacity measurement share that rate; a client whose request is still unanswered at its
next turn skips that turn, like a game server.
"""

import asyncio
import time
from collections import deque
from dataclasses import dataclass, field
from urllib.parse import urlsplit

import numpy as np
import orjson

from benchmarks.leagues.served_league import ACTION, PLANES
from benchmarks.load.http import Connection, measure, post

ROWS = 64
"""Observations per request: enough that the clients generate requests faster than the server answers them."""
CONNECTIONS = 64
"""Number of connections that measure the capacity."""
TIMES = 4
DRAIN = 10.0
"""Seconds that the last requests may take."""


@dataclass(slots=True)
class Overload:
    """The results. capacity: answers per second; p99, p99_before: milliseconds, of accepted requests."""

    capacity: float
    p99_before: float
    offered: int = 0
    rejected: int = 0
    without_retry_after: int = 0
    other: int = 0
    latencies: list[float] = field(default_factory=list)

    @property
    def answered(self) -> int:
        """The number of accepted requests."""
        return len(self.latencies)

    @property
    def p99(self) -> float:
        """99th percentile of the latency of accepted requests in milliseconds."""
        return float(np.percentile(self.latencies or [np.nan], 99) * 1e3)


class Caller(Connection):
    """A connection that sends a request when `ask` is called, instead of after each response."""

    def __init__(self, request: bytes, result: Overload, idle: deque["Caller"]) -> None:
        super().__init__(request, self.on_answer)
        self.result = result
        self.idle = idle
        self.head = b""

    def send_when_due(self) -> None:
        """Become idle."""
        self.idle.append(self)

    def ask(self) -> None:
        """Send the request."""
        self.send()

    def is_complete(self, head: bytes, body: int) -> bool:
        """See `Connection`."""
        self.head = head
        return super().is_complete(head, body)

    def on_answer(self, status: int, _: bytes, sent_at: float) -> bool:
        """Count the response."""
        if status == 200:
            self.result.latencies.append(time.perf_counter() - sent_at)
        elif status == 429:
            self.result.rejected += 1
            self.result.without_retry_after += b"retry-after:" not in self.head
        else:
            self.result.other += 1
        return True


def overload(url: str, seconds: float) -> Overload:
    """Measure the capacity of a server, then send four times as many requests."""
    import uvloop

    address = url + ACTION
    one = {"observation": PLANES.tolist(), "action_mask": [1] * 7}
    body = orjson.dumps({"observations": [one] * ROWS})
    before = measure(address, body, connections=CONNECTIONS, seconds=seconds, warm_up=1.0)
    result = Overload(before.rate, before.p99)
    uvloop.run(_offer(address, post(address, body), result, seconds))
    return result


async def _offer(url: str, request: bytes, result: Overload, seconds: float) -> None:
    """Send requests at a fixed rate, each on an idle connection."""
    parts = urlsplit(url)
    loop, idle = asyncio.get_running_loop(), deque[Caller]()
    for _ in range(TIMES * CONNECTIONS):
        await loop.create_connection(lambda: Caller(request, result, idle), parts.hostname, parts.port)
    start, turns = time.perf_counter(), 0
    while (passed := time.perf_counter() - start) < seconds:
        due = int(TIMES * result.capacity * passed) - turns
        for _ in range(min(due, len(idle))):
            idle.popleft().ask()
            result.offered += 1
        turns += due
        await asyncio.sleep(0.001)
    deadline = time.perf_counter() + DRAIN
    while result.answered + result.rejected + result.other < result.offered and time.perf_counter() < deadline:
        await asyncio.sleep(0.01)
    result.other += result.offered - result.answered - result.rejected - result.other
