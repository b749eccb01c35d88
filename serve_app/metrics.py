"""What a replica counts of itself, in plain integers: a request costs three additions, and calls no metrics library.

A report of all counts is written to the registry at each heartbeat (reporting.py); /metrics makes Prometheus's text of
the reports of all replicas (exposition.py).
"""

from collections import Counter
from dataclasses import dataclass, field
from time import monotonic, time
from typing import Any

from league.histograms import Histogram
from serve_app.live import Live
from serve_app.loading import LoadedVersion
from serve_app.models import policy_ref
from serve_app.permissions import league_of
from serve_app.shadow import Shadow
from serve_app.traffic import Traffic

KEPT = 1024
"""Policies and versions of which counts are kept; those that were not asked for longest are forgotten."""
SIZES = tuple(2**power for power in range(11))
"""Upper bounds of the buckets of batch sizes; a last bucket takes what is larger."""
REJECTIONS = ("unauthenticated", "forbidden", "rate_limited")
"""Codes of errors by which the doors refuse a caller."""

Label = tuple[str, str, str, str]
"""league, policy, version, api"""
Samples = list[list[Any]]
"""[[value of each label], value]; the value of a histogram is {counts, sum}."""
Report = dict[str, Samples]
"""Name of a metric → its samples."""


@dataclass(slots=True)
class Served:
    """Requests that one version of one policy has answered."""

    latency: Histogram = field(default_factory=Histogram)
    sizes: list[int] = field(default_factory=lambda: [0] * (len(SIZES) + 1))
    observations: int = 0
    used_at: float = 0.0
    told: int = 0
    """Requests at the last report."""

    def add(self, rows: int, ns: int) -> None:
        """Count a request of so many observations."""
        self.latency.add(ns)
        self.sizes[min((rows - 1).bit_length(), len(SIZES))] += 1
        self.observations += rows


class Metrics:
    """The counts of a replica, since it started. All methods run on the event loop."""

    def __init__(self, live: Live, traffic: Traffic, shadow: Shadow) -> None:
        self._live = live
        self._traffic = traffic
        self._shadow = shadow
        self._served: dict[Label, Served] = {}
        self._asked: dict[tuple[str, str, int], Served] = {}
        self._errors: Counter[tuple[str, str]] = Counter()
        self._started_at = time()
        self.in_flight: dict[str, int] = {}
        """api → requests that were begun and not answered yet, as of the last report"""

    def answered(self, api: str, model: str, version: LoadedVersion, rows: int, ns: int) -> None:
        """Count a request of `rows` observations that took so many nanoseconds."""
        served = self._asked.get((api, model, version.number))
        if served is None:
            served = self._first(api, model, version)
        served.add(rows, ns)

    def failed(self, path: str, code: str) -> None:
        """Count an answer that is an error, or the refusal of a request."""
        league = league_of(path) or ""
        # A stranger may ask for any league: only those that there are get counts of their own.
        self._errors[league if self._live.knows(league) else "", code] += 1

    def report(self) -> Report:
        """All counts."""
        return self._requests() | self._state() | self._mirrored()

    def _first(self, api: str, model: str, version: LoadedVersion) -> Served:
        policy = policy_ref(model).policy or next(iter(version.policies))
        label = (version.league, policy, str(version.number), api)
        if label not in self._served and len(self._served) >= KEPT:
            forgotten = min(self._served, key=lambda known: self._served[known].used_at)
            gone = self._served.pop(forgotten)
            self._asked = {asked: served for asked, served in self._asked.items() if served is not gone}
        served = self._served.setdefault(label, Served(used_at=monotonic()))
        self._asked[api, model, version.number] = served
        return served

    def _requests(self) -> Report:
        seconds: Samples = []
        sizes: Samples = []
        for label, served in self._served.items():
            count = served.latency.count
            if count != served.told:
                served.told, served.used_at = count, monotonic()
            seconds.append([list(label), {"counts": list(served.latency.counts), "sum": served.latency.ns / 1e9}])
            sizes.append([list(label), {"counts": list(served.sizes), "sum": served.observations}])
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
        leagues = self._live.leagues()
        return {
            "league_live_version": [
                [[league, alias], number] for league in leagues for alias, number in self._live.numbers(league).items()
            ],
            "league_faults": [[[league], int(self._live.fault(league) is not None)] for league in leagues],
            "league_swaps_total": [[[league], self._live.swaps[league]] for league in leagues],
            "league_requests_in_flight": [[[api], count] for api, count in self.in_flight.items()],
            "league_replica_start_time_seconds": [[[], self._started_at]],
            "league_replica_resident_bytes": [[[], _resident_bytes()]],
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
                [[league, str(number)], count] for (league, number), count in traffic.canaried.items()
            ],
            "league_canary_share": [[[league], side.share] for league, side in traffic.canaries.items()],
            "league_shadow_share": [[[league], side.share] for league, side in traffic.shadows.items()],
        }


def _resident_bytes() -> int:
    with open("/proc/self/statm", encoding="ascii") as file:
        pages = int(file.read().split()[1])
    return pages * 4096
