"""Requests that arrive at four times the rate that a server can take: not as fast as it answers, but by the clock.

Four times the clients of the measurement of capacity share that rate; a client whose request is not answered yet at its
next turn leaves that turn out, as a game server does.
"""

import asyncio
import time
from collections import deque
from dataclasses import dataclass, field
from urllib.parse import urlsplit

import numpy as np
import orjson

from benchmarks.load import Connection, measure, post
from benchmarks.served_league import LEAGUE, PLANES

ROWS = 64
"""Observations in a request: heavy enough that the machine's processors make requests faster than it answers them."""
CONNECTIONS = 64
"""That find out the capacity."""
TIMES = 4
DRAIN = 10.0
"""Seconds that the last requests may take."""
SLOWER = 2.0
"""How much longer 99 % of the accepted requests may take."""


@dataclass(slots=True)
class Overload:
    """What came of it. capacity: answers per second; p99, p99_before: milliseconds, of accepted requests."""

    capacity: float
    p99_before: float
    offered: int = 0
    refused: int = 0
    without_retry_after: int = 0
    other: int = 0
    latencies: list[float] = field(default_factory=list)

    @property
    def answered(self) -> int:
        """Requests that were accepted."""
        return len(self.latencies)

    @property
    def p99(self) -> float:
        """Of those."""
        return float(np.percentile(self.latencies or [np.nan], 99) * 1e3)

    @property
    def is_met(self) -> bool:
        """Whether nothing but 200 and 429 was seen, and the accepted were answered in time."""
        return not self.other and not self.without_retry_after and self.p99 <= SLOWER * self.p99_before


class Caller(Connection):
    """A connection that asks when it is told to, not as soon as it is answered."""

    def __init__(self, request: bytes, seen: Overload, idle: deque["Caller"]) -> None:
        super().__init__(request, self.on_answer)
        self.seen = seen
        self.idle = idle
        self.head = b""

    def send(self) -> None:
        """Wait."""
        self.idle.append(self)

    def ask(self) -> None:
        """Send the request."""
        super().send()

    def is_whole(self, head: bytes, body: int) -> bool:
        """See `Connection`."""
        self.head = head
        return super().is_whole(head, body)

    def on_answer(self, status: int, _: bytes, sent_at: float) -> bool:
        """Count."""
        if status == 200:
            self.seen.latencies.append(time.perf_counter() - sent_at)
        elif status == 429:
            self.seen.refused += 1
            self.seen.without_retry_after += b"retry-after:" not in self.head
        else:
            self.seen.other += 1
        return True


def overload(url: str, seconds: float) -> Overload:
    """Find out what a server can take, then ask for four times as much."""
    import uvloop

    address = f"{url}/v1/policies/{LEAGUE}/action"
    one = {"observation": PLANES.tolist(), "action_mask": [1] * 7}
    body = orjson.dumps({"observations": [one] * ROWS})
    before = measure(address, body, connections=CONNECTIONS, seconds=seconds, warm_up=1.0)
    seen = Overload(before.rate, before.p99)
    uvloop.run(_offer(address, post(address, body), seen, seconds))
    return seen


async def _offer(url: str, request: bytes, seen: Overload, seconds: float) -> None:
    """Send as the clock says, each request on a connection that waits for no answer."""
    parts = urlsplit(url)
    loop, idle = asyncio.get_running_loop(), deque[Caller]()
    for _ in range(TIMES * CONNECTIONS):
        await loop.create_connection(lambda: Caller(request, seen, idle), parts.hostname, parts.port)
    start, turns = time.perf_counter(), 0
    while (passed := time.perf_counter() - start) < seconds:
        due = int(TIMES * seen.capacity * passed) - turns
        for _ in range(min(due, len(idle))):
            idle.popleft().ask()
            seen.offered += 1
        turns += due
        await asyncio.sleep(0.001)
    deadline = time.perf_counter() + DRAIN
    while seen.answered + seen.refused + seen.other < seen.offered and time.perf_counter() < deadline:
        await asyncio.sleep(0.01)
    seen.other += seen.offered - seen.answered - seen.refused - seen.other
