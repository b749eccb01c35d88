"""Prometheus's text of what replicas report: each metric that there is, what it means, its value at each replica."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily, Metric
from prometheus_client.registry import Collector

from league.histograms import BOUNDS
from serve_app.metrics import SIZES, Report

SECONDS = tuple(bound / 1e6 for bound in BOUNDS)
SERVED = ("league", "policy", "version", "api")
PAIR = ("league", "candidate", "champion")


@dataclass(frozen=True, slots=True)
class Definition:
    """A metric. Besides `labels`, each sample has the label `replica`."""

    kind: Literal["counter", "gauge", "histogram"]
    help: str
    labels: tuple[str, ...] = ()
    bounds: tuple[float, ...] = ()


METRICS = {
    "league_request_seconds": Definition(
        "histogram", "Time from a request's arrival in the replica to its answer.", SERVED, SECONDS
    ),
    "league_batch_observations": Definition("histogram", "Observations in a request.", SERVED, SIZES),
    "league_errors_total": Definition(
        "counter", "Answers that were errors, by their code; without a league where it is unknown.", ("league", "code")
    ),
    "league_key_rejections_total": Definition(
        "counter", "Requests refused for their API key: none or void, of another scope, too often.", ("code",)
    ),
    "league_live_version": Definition("gauge", "The version that answers for an alias.", ("league", "alias")),
    "league_faults": Definition("gauge", "1 while an alias is not served as it should be.", ("league",)),
    "league_swaps_total": Definition("counter", "Hot swaps: times that an alias got another version.", ("league",)),
    "league_requests_in_flight": Definition("gauge", "Requests begun and not answered yet.", ("api",)),
    "league_evaluations": Definition(
        "gauge", "Evaluations over HTTP that are queued or running; of no replica.", ("league", "state")
    ),
    "league_replica_start_time_seconds": Definition("gauge", "When the replica started, since 1970."),
    "league_replica_resident_bytes": Definition("gauge", "Memory of the replica's process."),
    "league_canary_share": Definition("gauge", "Share of keys that the canary answers.", ("league",)),
    "league_canary_requests_total": Definition("counter", "Requests that a canary answered.", ("league", "version")),
    "league_shadow_share": Definition("gauge", "Share of requests that are mirrored to the shadow.", ("league",)),
    "league_shadow_requests_total": Definition("counter", "Mirrored requests that were compared.", PAIR),
    "league_shadow_observations_total": Definition("counter", "Observations in mirrored requests.", PAIR),
    "league_shadow_agreed_total": Definition(
        "counter", "Mirrored observations on which candidate and champion take the same action.", PAIR
    ),
    "league_shadow_failed_total": Definition("counter", "Mirrored requests that the candidate did not answer.", PAIR),
    "league_shadow_dropped_total": Definition("counter", "Requests not mirrored for want of time.", PAIR),
    "league_shadow_skipped_total": Definition("counter", "Requests not mirrored as they have recurrent state.", PAIR),
    "league_shadow_inference_seconds": Definition(
        "histogram", "Processor time of the candidate for one mirrored request.", PAIR, SECONDS
    ),
}
"""By name, as replicas report them."""


def text(reports: Mapping[str, Report]) -> bytes:
    """Prometheus's text format, of replica → its report. What no metric is called is left out."""
    registry = CollectorRegistry()
    registry.register(_Reports(reports))
    return generate_latest(registry)


class _Reports(Collector):
    def __init__(self, reports: Mapping[str, Report]) -> None:
        self._reports = reports

    def collect(self) -> Iterator[Metric]:
        for name, definition in METRICS.items():
            samples = [
                ([*labels, replica], value)
                for replica, report in self._reports.items()
                for labels, value in report.get(name, ())
            ]
            yield _family(name, definition, samples)


def _family(name: str, definition: Definition, samples: Iterable[tuple[list[str], Any]]) -> Metric:
    labels = (*definition.labels, "replica")
    if definition.kind == "histogram":
        histogram = HistogramMetricFamily(name, definition.help, labels=labels)
        for values, value in samples:
            histogram.add_metric(values, _buckets(definition.bounds, value["counts"]), value["sum"])
        return histogram
    kind = CounterMetricFamily if definition.kind == "counter" else GaugeMetricFamily
    family = kind(name, definition.help, labels=labels)
    for values, value in samples:
        family.add_metric(values, value)
    return family


def _buckets(bounds: tuple[float, ...], counts: list[int]) -> list[tuple[str, float]]:
    """Upper bound → how many were at most that."""
    seen, buckets = 0, []
    for bound, count in zip((*map(str, bounds), "+Inf"), counts, strict=True):
        seen += count
        buckets.append((bound, float(seen)))
    return buckets
