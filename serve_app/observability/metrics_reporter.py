"""Writes a replica's metrics and request rates to the registry, with the free space of its machine's disks."""

import asyncio
import os
from collections import Counter
from collections.abc import AsyncIterator, Callable, Iterable, Mapping
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from threading import Thread
from time import monotonic

from league.errors import LeagueError
from league.registry.storage.rows import ShadowCounts
from league.settings import Storage
from serve_app.live_versions.polling import Polling
from serve_app.live_versions.registry_connection import SHUTDOWN_TIMEOUT, RegistryConnection
from serve_app.live_versions.shadow import Shadow
from serve_app.observability.metrics import Metrics, Report, Samples
from serve_app.settings import ServeSettings


class DiskSpace:
    """Free and total bytes of the disks of the home and of the artefact store, unless that is an object store.

    A network disk that does not respond blocks whoever asks for its size. Therefore a thread measures, and a disk
    without an answer has no samples.
    """

    def __init__(self, storage: Storage) -> None:
        disks = {"home": storage.home, "artifacts": storage.artifacts}
        self._paths: Mapping[str, Path] = {disk: path for disk, path in disks.items() if isinstance(path, Path)}
        self._sizes: dict[str, tuple[int, int]] = {}
        self._threads: dict[str, Thread] = {}

    def report(self) -> Report:
        """Return the last measured sizes, and start the next measurement."""
        sizes, self._sizes = self._sizes, {}
        for disk, path in self._paths.items():
            if disk not in self._threads or not self._threads[disk].is_alive():
                self._threads[disk] = Thread(target=self._measure, args=(disk, path), name="disk", daemon=True)
                self._threads[disk].start()
        return {
            "league_disk_free_bytes": [[[disk], free] for disk, (free, _) in sizes.items()],
            "league_disk_size_bytes": [[[disk], size] for disk, (_, size) in sizes.items()],
        }

    def _measure(self, disk: str, path: Path) -> None:
        with suppress(OSError):
            file_system = os.statvfs(path)
            # As `df` has it: the part that is reserved for root is neither free nor counted.
            free = file_system.f_bavail * file_system.f_frsize
            used = (file_system.f_blocks - file_system.f_bfree) * file_system.f_frsize
            self._sizes[disk] = free, used + free


SECONDS = "league_request_seconds"
RATE = "league_requests_per_second"


@dataclass(frozen=True, slots=True)
class RequestCounts:
    """Requests of one league, over all replicas that report."""

    requests: int = 0
    """Since the replicas started."""
    requests_per_second: float = 0.0
    """Between their last two reports."""


class RequestRates:
    """Request rates of a replica between reports."""

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()
        self._at = monotonic()

    def since_last(self, report: Report) -> Samples:
        """league → requests per second since the last call."""
        counts, current_time = _counts(report), monotonic()
        seconds = max(current_time - self._at, 1e-3)
        # Counts of policies that were not used for long are dropped.
        rates: Samples = [
            [[league], max(count - self._counts[league], 0) / seconds] for league, count in counts.items()
        ]
        self._counts, self._at = counts, current_time
        return rates


def request_counts(reports: Iterable[Report]) -> dict[str, RequestCounts]:
    """league → its requests, for leagues with any."""
    counts: Counter[str] = Counter()
    rates: Counter[str] = Counter()
    for report in reports:
        counts += _counts(report)
        for (league,), rate in report.get(RATE, ()):
            rates[league] += rate
    return {league: RequestCounts(count, float(rates[league])) for league, count in counts.items()}


def _counts(report: Report) -> Counter[str]:
    counts: Counter[str] = Counter()
    for (league, *_), value in report.get(SECONDS, ()):
        counts[league] += sum(value["counts"])
    return counts


class MetricsReporter:
    """Reports in its own task, so that no report delays a promotion. Counting continues while the database is
    unavailable. `further`: what other parts of the replica add to each report.
    """

    def __init__(
        self,
        connection: RegistryConnection,
        metrics: Metrics,
        shadow: Shadow,
        further: Callable[[], Report],
        replica: str,
        settings: ServeSettings,
    ) -> None:
        self._connection = connection
        self._metrics = metrics
        self._shadow = shadow
        self._further = further
        self._replica = replica
        self._polling = Polling(self._poll, "reports", settings.heartbeat, settings.poll_slowest)
        self._rates = RequestRates()
        self._last_rates: Samples = []
        self._disks = DiskSpace(connection.storage)
        self._written: dict[tuple[str, int, int], ShadowCounts] = {}

    @asynccontextmanager
    async def reporting(self) -> AsyncIterator[None]:
        """Report while the context is active, and once more on exit."""
        try:
            async with self._polling.running():
                yield
        finally:
            with suppress(LeagueError, TimeoutError):
                await asyncio.wait_for(self.report(), SHUTDOWN_TIMEOUT)

    async def _poll(self) -> None:
        self._last_rates = self._rates.since_last(self._metrics.report())
        await self.report()

    async def report(self) -> None:
        """Write all metrics, the request rates of the last regular report, and the shadow counts that changed. Raises
        StorageError."""
        self._polling.mark_ready()
        shadowings = [
            one
            for one in self._shadow.shadowings()
            if self._written.get((one.league, one.candidate, one.champion)) != one
        ]
        report = self._metrics.report()
        report |= {RATE: self._last_rates} | self._disks.report() | self._further()
        await self._connection.call(lambda registry: registry.replicas.write_report(self._replica, report, shadowings))
        self._written |= {(one.league, one.candidate, one.champion): one for one in shadowings}
