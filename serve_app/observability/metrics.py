"""Counts requests, errors and inference times of a replica in plain integers, without a metrics library on the hot
path.

The metrics reporter writes all counts to the registry at each heartbeat; /metrics renders the reports of all replicas
for Prometheus.
"""

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from time import monotonic, perf_counter_ns, time
from typing import Any

from league.histograms import Histogram
from serve_app.access.permissions import league_of
from serve_app.live_versions.alias_slots import AliasSlots
from serve_app.live_versions.policies import LoadedPolicy
from serve_app.live_versions.shadow import Shadow
from serve_app.live_versions.traffic_split import TrafficSplit

MAX_SERIES = 1024
"""Maximum policies and versions with counts; the least recently used are dropped."""
BATCH_SIZES = tuple(2**power for power in range(11))
"""Upper bounds of the batch-size buckets; a last bucket holds larger batches."""
REJECTIONS = ("unauthenticated", "forbidden", "rate_limited")
"""Error codes of requests that access control refused."""
MEMORY, PAGE_SIZE = Path("/proc/self/statm"), 4096
"""The second number of the file is that of resident pages."""

Label = tuple[str, str, int, str]
"""league, policy, version, api"""
Samples = list[list[Any]]
"""[[label values, value]]; the value of a histogram is {counts, sum}."""
Report = dict[str, Any]
"""Metric name → samples, and further parts by name."""


@dataclass(slots=True)
class RequestStats:
    """Requests answered by one version of one policy."""

    latency: Histogram = field(default_factory=Histogram)
    sizes: list[int] = field(default_factory=lambda: [0] * (len(BATCH_SIZES) + 1))
    observations: int = 0
    used_at: float = 0.0
    reported: int = 0
    """Requests at the last report."""

    def add(self, rows: int, ns: int) -> None:
        """Count a request with `rows` observations."""
        self.latency.add(ns)
        self.sizes[min((rows - 1).bit_length(), len(BATCH_SIZES))] += 1
        self.observations += rows


class Metrics:
    """The counts of a replica since it started. All methods run on the event loop."""

    def __init__(self, slots: AliasSlots, traffic: TrafficSplit, shadow: Shadow) -> None:
        self._slots = slots
        self._traffic = traffic
        self._shadow = shadow
        self._served: dict[Label, RequestStats] = {}
        self._errors: Counter[tuple[str, str]] = Counter()
        self._started_at = time()

    def count_request(self, api: str, policy: LoadedPolicy, rows: int, begun: int) -> None:
        """Count a request of `rows` observations that is answered now. begun: a time of `perf_counter_ns`."""
        label = (policy.league, policy.name, policy.number, api)
        served = self._served.get(label)
        if served is None:
            if len(self._served) >= MAX_SERIES:
                del self._served[min(self._served, key=lambda known: self._served[known].used_at)]
            served = self._served[label] = RequestStats(used_at=monotonic())
        served.add(rows, perf_counter_ns() - begun)

    def count_error(self, path: str, code: str) -> None:
        """Count an error response or a refused request."""
        league = league_of(path) or ""
        # Clients can name any league: only existing ones get a series of their own.
        self._errors[league if self._slots.knows(league) else "", code] += 1

    def totals(self) -> dict[str, tuple[int, int]]:
        """api → requests that were answered, and nanoseconds from their arrivals to their responses."""
        totals: dict[str, tuple[int, int]] = {}
        for (*_, api), served in self._served.items():
            count, ns = totals.get(api, (0, 0))
            totals[api] = count + served.latency.count, ns + served.latency.ns
        return totals

    def report(self) -> Report:
        """All counts."""
        return self._requests() | self._state() | self._mirrored()

    def _requests(self) -> Report:
        seconds: Samples = []
        sizes: Samples = []
        for label, served in self._served.items():
            count = served.latency.count
            if count != served.reported:
                served.reported, served.used_at = count, monotonic()
            labels = list(map(str, label))
            seconds.append([labels, {"counts": list(served.latency.counts), "sum": served.latency.ns / 1e9}])
            sizes.append([labels, {"counts": list(served.sizes), "sum": served.observations}])
        errors: Samples = [[[league, code], count] for (league, code), count in self._errors.items()]
        rejected: Samples = [
            [[code], sum(count for (_, other), count in self._errors.items() if other == code)] for code in REJECTIONS
        ]
        return {
            "league_request_seconds": seconds,
            "league_batch_observations": sizes,
            "league_errors_total": errors,
            "league_key_rejections_total": rejected,
        }

    def _state(self) -> Report:
        leagues, numbers, faults = self._slots.leagues(), self._slots.numbers(), self._slots.faults()
        return {
            "league_live_version": [
                [[league, alias], number] for league in leagues for alias, number in numbers.get(league, {}).items()
            ],
            "league_mixture_probability": [
                [[league, alias, str(member.version)], member.probability]
                for league in leagues
                for alias in numbers.get(league, {})
                if (version := self._slots.get(league, alias)) and version.mixture
                for member in version.mixture.members
            ],
            "league_faults": [[[league], int(league in faults)] for league in leagues],
            "league_swaps_total": [[[league], self._slots.swaps[league]] for league in leagues],
            "league_replica_start_time_seconds": [[[], self._started_at]],
            "league_replica_resident_bytes": [[[], PAGE_SIZE * int(MEMORY.read_text("ascii").split()[1])]],
        }

    def _mirrored(self) -> Report:
        traffic, shadowings = self._traffic, self._shadow.shadowings()
        pairs = [[one.league, str(one.candidate), str(one.champion)] for one in shadowings]
        counts = ("requests", "observations", "agreed", "failed", "dropped", "skipped")
        by_name: Report = {
            f"league_shadow_{name}_total": [
                [pair, getattr(one, name)] for pair, one in zip(pairs, shadowings, strict=True)
            ]
            for name in counts
        }
        return by_name | {
            "league_shadow_inference_seconds": [
                [pair, {"counts": list(one.latency), "sum": one.ns / 1e9}]
                for pair, one in zip(pairs, shadowings, strict=True)
            ],
            "league_canary_requests_total": [
                [[league, str(number)], count] for (league, number), count in traffic.canary_requests.items()
            ],
            "league_canary_share": [[[league], target.share] for league, target in traffic.canaries.items()],
            "league_shadow_share": [[[league], target.share] for league, target in traffic.shadows.items()],
        }
