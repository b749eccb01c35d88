"""A lightweight HTTP/1.1 load generator: raw sockets, keep-alive, one request in flight per connection.

Each request costs it a few microseconds.
"""

import asyncio
import math
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from random import random
from typing import cast
from urllib.parse import urlsplit

import numpy as np
import orjson
import psutil
from numpy.typing import NDArray

from benchmarks.load.elsewhere import run_elsewhere
from league.policies.open_inference import DATATYPES


@dataclass(frozen=True, slots=True)
class Load:
    """The results of one run. Times in milliseconds; `failed`: dropped connections and statuses other than 200.

    processor: seconds of processor time of all processes of the server.
    """

    requests: int
    seconds: float
    failed: int
    statuses: dict[str, int]
    p50: float
    p99: float
    max: float
    processor: float

    @property
    def rate(self) -> float:
        """Responses with status 200 per second."""
        return (self.requests - self.failed) / self.seconds

    @property
    def cost(self) -> float:
        """Microseconds of the server's processor time per response with status 200."""
        return 1e6 * self.processor / (self.requests - self.failed or math.nan)


OnReply = Callable[[int, bytes, float], bool]
"""(status, body, time.perf_counter() at sending) → whether to send again. Status 0: the connection was dropped."""


JSON = {"Content-Type": "application/json"}
BINARY = {"Content-Type": "application/octet-stream"}
LENGTH = b"content-length: "
LAST_CHUNK = b"0\r\n\r\n"


class Connection(asyncio.Protocol):
    """Sends `request` again as soon as its response is complete, or every `interval` seconds, and reports each
    response.

    A request that is due while the previous one is unanswered counts as sent when it was due, so that a slow server is
    charged for all waiting requests (Tene's coordinated omission).
    """

    def __init__(self, request: bytes, on_reply: OnReply, interval: float = 0.0) -> None:
        self.request = request
        self.on_reply = on_reply
        self.interval = interval
        self.closed = asyncio.get_running_loop().create_future()
        self.received = b""
        self.sent_at = 0.0
        self.waiting = False

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = cast(asyncio.Transport, transport)
        self.due = time.perf_counter() + random() * self.interval
        self.send_when_due()

    def send_when_due(self) -> None:
        early = self.due - time.perf_counter()
        if early > 0:
            asyncio.get_running_loop().call_later(early, self.send)
        else:
            self.send(self.due if self.interval else None)

    def send(self, sent_at: float | None = None) -> None:
        if self.transport.is_closing():
            return
        self.waiting = True
        self.sent_at = sent_at or time.perf_counter()
        self.due += self.interval
        self.transport.write(self.request)

    def data_received(self, data: bytes) -> None:
        self.received = self.received + data if self.received else data
        end = self.received.find(b"\r\n\r\n")
        if end < 0:
            return
        head = self.received[:end].lower()
        if not self.is_complete(head, end + 4):
            return
        reply, self.received, self.waiting = self.received, b"", False
        if self.on_reply(int(reply[9:12]), reply[end + 4 :], self.sent_at) and b"connection: close" not in head:
            self.send_when_due()
        else:
            self.transport.close()

    def is_complete(self, head: bytes, body: int) -> bool:
        """Whether a response whose body starts at `body` has arrived, with a stated length or in chunks."""
        at = head.find(LENGTH)
        if at < 0:
            return self.received.endswith(LAST_CHUNK)
        stop = head.find(b"\r", at)
        return len(self.received) >= body + int(head[at + len(LENGTH) : stop if stop > 0 else None])

    def connection_lost(self, _: Exception | None) -> None:
        if self.waiting:
            self.on_reply(0, b"", self.sent_at)
        self.closed.set_result(None)


def post(url: str, body: bytes, headers: Mapping[str, str] = JSON) -> bytes:
    """The bytes of a POST to `url`."""
    parts = urlsplit(url)
    path = parts.path + (f"?{parts.query}" if parts.query else "")
    lines = [f"POST {path} HTTP/1.1", f"Host: {parts.netloc}", f"Content-Length: {len(body)}"]
    lines += [f"{name}: {value}" for name, value in headers.items()]
    return "\r\n".join(lines).encode() + b"\r\n\r\n" + body


def binary(arrays: Mapping[str, NDArray], outputs: Sequence[str] = ("action",)) -> tuple[bytes, dict[str, str]]:
    """A request of the Open Inference Protocol with the binary tensor extension: its body and its headers."""
    inputs = [
        {
            "name": name,
            "shape": list(array.shape),
            "datatype": DATATYPES[array.dtype.name],
            "parameters": {"binary_data_size": array.nbytes},
        }
        for name, array in arrays.items()
    ]
    wanted_outputs = [{"name": name, "parameters": {"binary_data": True}} for name in outputs]
    head = orjson.dumps({"inputs": inputs, "outputs": wanted_outputs})
    body = head + b"".join(array.tobytes() for array in arrays.values())
    return body, BINARY | {"Inference-Header-Content-Length": str(len(head))}


async def drive(
    url: str,
    body: bytes,
    connections: int,
    on_reply: OnReply,
    is_running: Callable[[], bool],
    *,
    rate: float = 0.0,
    headers: Mapping[str, str] = JSON,
) -> None:
    """Keep `connections` busy until `is_running()` is false; dropped connections are reopened.

    rate: requests per second of all connections together; 0: each as fast as it is answered.
    """
    parts = urlsplit(url)
    request = post(url, body, headers)
    interval = connections / rate if rate else 0.0

    async def keep_busy() -> None:
        loop = asyncio.get_running_loop()
        while is_running():
            try:
                _, connection = await loop.create_connection(
                    lambda: Connection(request, on_reply, interval), parts.hostname, parts.port
                )
            except OSError:
                on_reply(0, b"", time.perf_counter())
                await asyncio.sleep(0.05)
                continue
            await connection.closed

    await asyncio.gather(*(keep_busy() for _ in range(connections)))


async def run(
    url: str,
    body: bytes,
    connections: int,
    seconds: float,
    warm_up: float,
    rate: float,
    headers: Mapping[str, str],
    server: Sequence[int],
) -> Load:
    """Load `url` for `warm_up + seconds`; the warm-up is not counted."""
    statuses: Counter[str] = Counter()
    latencies: list[float] = []
    start = time.perf_counter() + warm_up
    stop = start + seconds

    def on_reply(status: int, _: bytes, sent_at: float) -> bool:
        replied_at = time.perf_counter()
        if start <= replied_at <= stop:
            statuses[str(status)] += 1
            latencies.append(replied_at - sent_at)
        return replied_at < stop

    processor, _ = await asyncio.gather(
        _processor(server, start, stop),
        drive(url, body, connections, on_reply, lambda: time.perf_counter() < stop, rate=rate, headers=headers),
    )
    times = np.array(latencies or [np.nan]) * 1e3
    p50, p99 = map(float, np.percentile(times, [50, 99]))
    requests = statuses.total()
    return Load(requests, seconds, requests - statuses["200"], dict(statuses), p50, p99, float(times.max()), processor)


async def _processor(roots: Sequence[int], start: float, stop: float) -> float:
    """Seconds of processor time between two times, of these processes and those below them."""
    readings = []
    for moment in (start, stop):
        await asyncio.sleep(moment - time.perf_counter())
        reading = {}
        for root in map(psutil.Process, roots):
            for process in (root, *root.children(recursive=True)):
                with suppress(psutil.NoSuchProcess):
                    times = process.cpu_times()
                    reading[process.pid] = times.user + times.system
        readings.append(reading)
    before, after = readings
    return sum(spent - before.get(process, 0.0) for process, spent in after.items())


def measure(
    url: str,
    body: bytes,
    *,
    connections: int,
    seconds: float,
    warm_up: float = 1.0,
    rate: float = 0.0,
    headers: Mapping[str, str] = JSON,
    server: Sequence[int] = (),
) -> Load:
    """Run the generator in a process of its own. server: ids of the processes of which all others of the server are
    descendants.
    """
    return run_elsewhere(run, url, body, connections, seconds, warm_up, rate, dict(headers), server)
