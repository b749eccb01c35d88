"""Requests at a rate that changes in steps, and next to them the calls of our client.

The requests are single attempts over open connections; our client repeats failed ones. Both wait for their turn, not
for answers: a slow server gets no fewer.
"""

import asyncio
import time
from dataclasses import dataclass, field

from benchmarks.leagues.served_league import ACTION, BODY, LEAGUE, PLANES
from benchmarks.load.elsewhere import Stage
from benchmarks.load.http import drive
from league.errors import LeagueError
from policy_league_client import AsyncClient

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


async def step(stage: Stage, url: str) -> Steps:
    """Follow the rates, in requests per second, that the stage receives; at first only our client calls."""
    load, loop = _Load(stage, url), asyncio.get_running_loop()
    stage.on_message = lambda rate: loop.call_soon_threadsafe(load.set_rate, rate)
    clients = [asyncio.create_task(load.call()) for _ in range(CLIENTS)]
    stage.ready()
    await stage.over()
    load.set_rate(0)
    await asyncio.gather(*load.requests, *clients)
    return load.record


class _Load:
    def __init__(self, stage: Stage, url: str) -> None:
        self.record = Steps()
        self._url = url
        self._step = 0
        self._stage = stage
        self.requests: list[asyncio.Task[None]] = []

    def set_rate(self, rate: float) -> None:
        self._step += 1
        if rate:
            self.requests.append(asyncio.create_task(self._request(rate, self._step)))

    async def _request(self, rate: float, step: int) -> None:
        def on_reply(status: int, _: bytes, __: float) -> bool:
            self.record.attempts += 1
            if status != 200:
                self.record.statuses[str(status)] = self.record.statuses.get(str(status), 0) + 1
            return self._step == step

        await drive(self._url + ACTION, BODY, CONNECTIONS, on_reply, lambda: self._step == step, rate=rate)

    async def call(self) -> None:
        async with AsyncClient(self._url) as client:
            while not self._stage.is_over:
                start = time.monotonic()
                try:
                    response = await client.act(LEAGUE, OBSERVATION)
                except LeagueError as error:
                    self.record.lost.append(f"{type(error).__name__}: {str(error)[:120]}")
                else:
                    replied_at = time.monotonic()
                    first, _ = self.record.replicas.get(response.replica, (replied_at, replied_at))
                    self.record.replicas[response.replica] = first, replied_at
                    self.record.longest = max(self.record.longest, replied_at - start)
                self.record.calls += 1
                await asyncio.sleep(max(0.0, start + INTERVAL - time.monotonic()))
