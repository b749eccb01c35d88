"""Writes what a replica counts to the registry, at each heartbeat and once more when it stops."""

import asyncio
from collections.abc import AsyncIterator, Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager, suppress
from functools import partial

from league.errors import LeagueError
from league.registry.registry import Registry
from league.registry.rows import Shadowing
from serve_app.alias_watcher import GOODBYE
from serve_app.metrics import Metrics
from serve_app.polling import Polling
from serve_app.request_rates import RATE, RequestRates
from serve_app.settings import ServeSettings
from serve_app.shadow import Shadow


class Reporter:
    """Beside the alias watcher, so that no report delays a promotion. While the database is gone, counting goes on."""

    def __init__(
        self,
        registry: Registry,
        metrics: Metrics,
        shadow: Shadow,
        in_flight: Callable[[], dict[str, int]],
        replica: str,
        settings: ServeSettings,
    ) -> None:
        self._registry = registry
        self._metrics = metrics
        self._shadow = shadow
        self._in_flight = in_flight
        self._replica = replica
        slowest = max(settings.heartbeat, settings.poll_slowest)
        pace = settings.model_copy(update={"poll": settings.heartbeat, "poll_slowest": slowest})
        self._polling = Polling(self.report, "reports", pace)
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="report")
        self._rates = RequestRates()
        self._written: dict[tuple[str, int, int], Shadowing] = {}

    @asynccontextmanager
    async def reporting(self) -> AsyncIterator[None]:
        """Report while the context lasts."""
        try:
            async with self._polling.running():
                yield
        finally:
            with suppress(LeagueError, TimeoutError):
                await asyncio.wait_for(self.report(), GOODBYE)
            self._thread.shutdown(wait=False, cancel_futures=True)

    async def report(self) -> None:
        """Write all metrics, and the shadows of which there is news. Raises StorageError."""
        self._polling.saw()
        self._metrics.in_flight = self._in_flight()
        shadowings = [
            one
            for one in self._shadow.shadowings()
            if self._written.get((one.league, one.candidate, one.champion)) != one
        ]
        report = self._metrics.report()
        report |= {RATE: self._rates.since_last(report)}
        write = partial(self._registry.report, self._replica, report, shadowings)
        await asyncio.get_running_loop().run_in_executor(self._thread, write)
        self._written |= {(one.league, one.candidate, one.champion): one for one in shadowings}
