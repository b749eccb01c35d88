"""The calls of clients during faults: half of them with our client, half with a client without retries."""

import asyncio
import time
from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.leagues.served_league import ACTION, BODY, LEAGUE, PLANES
from benchmarks.load.elsewhere import Stage
from benchmarks.load.http import drive
from league.errors import LeagueError
from policy_league_client import AsyncClient

CALLERS = 4
"""Callers of each kind. Each calls again as soon as it has an answer."""
WITH_RETRIES, WITHOUT_RETRIES = 0.0, 1.0
"""The kinds of clients: ours, which retries, and one that does not."""


@dataclass(frozen=True, slots=True)
class CallLog:
    """The calls of one run.

    calls: (n, 4): kind, start and end by `time.perf_counter`; 1 if it was answered, else 0. errors: exceptions of our
    client → count.
    """

    calls: NDArray
    errors: dict[str, int]

    def failed(self, kind: float) -> NDArray:
        """The end times of the failed calls of a kind."""
        times: NDArray = self.calls[(self.calls[:, 0] == kind) & (self.calls[:, 3] == 0), 2]
        return times

    def p99(self, kind: float) -> float:
        """99th percentile of the duration of answered calls in milliseconds, including retries and delays."""
        answered = self.calls[(self.calls[:, 0] == kind) & (self.calls[:, 3] == 1)]
        return float(np.percentile(answered[:, 2] - answered[:, 1], 99) * 1e3) if len(answered) else float("nan")


async def call(stage: Stage, url: str) -> CallLog:
    """Call until the stage is over, which begins with the first answer."""
    calls: list[tuple[float, ...]] = []
    errors: Counter[str] = Counter()
    observation = {"observation": PLANES, "action_mask": np.ones(7, np.int8)}

    def record(kind: float, sent_at: float, is_answered: bool) -> None:
        if not calls:
            stage.ready()
        calls.append((kind, sent_at, time.perf_counter(), float(is_answered)))

    def on_reply(status: int, _: bytes, sent_at: float) -> bool:
        record(WITHOUT_RETRIES, sent_at, status == 200)
        return not stage.is_over

    async def call_with_retries() -> None:
        async with AsyncClient(url) as client:
            while not stage.is_over:
                sent_at = time.perf_counter()
                try:
                    await client.act(LEAGUE, observation)
                except LeagueError as error:
                    errors[f"{type(error).__name__}: {str(error)[:120]}"] += 1
                    record(WITH_RETRIES, sent_at, False)
                else:
                    record(WITH_RETRIES, sent_at, True)

    once = drive(url + ACTION, BODY, CALLERS, on_reply, lambda: not stage.is_over)
    await asyncio.gather(once, *(call_with_retries() for _ in range(CALLERS)))
    return CallLog(np.array(calls), dict(errors))
