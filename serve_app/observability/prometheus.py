"""Renders the reports of all replicas in the Prometheus text format."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import accumulate
from typing import Any, Literal

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily, Metric
from prometheus_client.registry import Collector

from league.histograms import BOUNDS
from serve_app.observability.metrics import BATCH_SIZES, Report

SECONDS = tuple(bound / 1e6 for bound in BOUNDS)
REQUEST_LABELS = ("league", "policy", "version", "api")
SHADOW_LABELS = ("league", "candidate", "champion")


@dataclass(frozen=True, slots=True)
class MetricDefinition:
    """A metric. Each sample also has the label `replica`."""

    kind: Literal["counter", "gauge", "histogram"]
    help: str
    labels: tuple[str, ...] = ()
    bounds: tuple[float, ...] = ()


METRICS = {
    "league_request_seconds": MetricDefinition(
        "histogram", "Time from the arrival of a request in the replica to its response.", REQUEST_LABELS, SECONDS
    ),
    "league_batch_observations": MetricDefinition(
        "histogram", "Observations in a request.", REQUEST_LABELS, BATCH_SIZES
    ),
    "league_errors_total": MetricDefinition(
        "counter", "Error responses by code; the league label is empty if the league is unknown.", ("league", "code")
    ),
    "league_key_rejections_total": MetricDefinition(
        "counter",
        "Requests refused because of their API key: missing or invalid, wrong scope, or rate limit.",
        ("code",),
    ),
    "league_live_version": MetricDefinition("gauge", "The version that answers for an alias.", ("league", "alias")),
    "league_mixture_probability": MetricDefinition(
        "gauge", "Probability of a member of the mixture that answers for an alias.", ("league", "alias", "version")
    ),
    "league_faults": MetricDefinition("gauge", "1 while an alias is not served as the registry requires.", ("league",)),
    "league_swaps_total": MetricDefinition("counter", "Hot swaps of an alias to another version.", ("league",)),
    "league_requests_in_flight": MetricDefinition("gauge", "Requests in flight.", ("api",)),
    "league_evaluations": MetricDefinition(
        "gauge", "Evaluations that are queued or running, for all replicas.", ("league", "state")
    ),
    "league_silent_replicas": MetricDefinition(
        "gauge", "Registered replicas that are stuck or cut off from the database: no report for 15 s."
    ),
    "league_replica_start_time_seconds": MetricDefinition(
        "gauge", "Start time of the replica, in seconds since the epoch."
    ),
    "league_replica_load": MetricDefinition(
        "gauge", "Load of the replica, by which the number of replicas is decided: 1 is a core."
    ),
    "league_replica_resident_bytes": MetricDefinition("gauge", "Resident memory of the replica process."),
    "league_disk_free_bytes": MetricDefinition(
        "gauge", "Free space on the disk of the home or of the artefact store.", ("disk",)
    ),
    "league_disk_size_bytes": MetricDefinition("gauge", "Size of this disk.", ("disk",)),
    "league_canary_share": MetricDefinition("gauge", "Share of keys that are routed to the canary.", ("league",)),
    "league_canary_requests_total": MetricDefinition(
        "counter", "Requests answered by a canary.", ("league", "version")
    ),
    "league_shadow_share": MetricDefinition("gauge", "Share of requests that are mirrored to the shadow.", ("league",)),
    "league_shadow_requests_total": MetricDefinition("counter", "Mirrored requests that were compared.", SHADOW_LABELS),
    "league_shadow_observations_total": MetricDefinition(
        "counter", "Observations in mirrored requests.", SHADOW_LABELS
    ),
    "league_shadow_agreed_total": MetricDefinition(
        "counter", "Mirrored observations on which candidate and champion chose the same action.", SHADOW_LABELS
    ),
    "league_shadow_failed_total": MetricDefinition(
        "counter", "Mirrored requests on which the candidate failed.", SHADOW_LABELS
    ),
    "league_shadow_dropped_total": MetricDefinition(
        "counter", "Requests not mirrored because the shadow was busy.", SHADOW_LABELS
    ),
    "league_shadow_skipped_total": MetricDefinition(
        "counter", "Requests not mirrored because they have recurrent state.", SHADOW_LABELS
    ),
    "league_shadow_inference_seconds": MetricDefinition(
        "histogram", "CPU time of the candidate for one mirrored request.", SHADOW_LABELS, SECONDS
    ),
}
"""Name in reports → definition."""


FAMILIES: dict[str, Any] = {
    "counter": CounterMetricFamily,
    "gauge": GaugeMetricFamily,
    "histogram": HistogramMetricFamily,
}


def render(reports: Mapping[str, Report]) -> bytes:
    """Render replica → report in the Prometheus text format. Unknown metrics are ignored."""
    registry = CollectorRegistry()
    registry.register(_ReportCollector(reports))
    return generate_latest(registry)


class _ReportCollector(Collector):
    def __init__(self, reports: Mapping[str, Report]) -> None:
        self._reports = reports

    def collect(self) -> Iterator[Metric]:
        for name, definition in METRICS.items():
            family = FAMILIES[definition.kind](name, definition.help, labels=(*definition.labels, "replica"))
            bounds = (*map(str, definition.bounds), "+Inf")
            for replica, report in self._reports.items():
                for labels, value in report.get(name, ()):
                    if definition.kind == "histogram":
                        cumulative = map(float, accumulate(value["counts"]))
                        family.add_metric([*labels, replica], list(zip(bounds, cumulative, strict=True)), value["sum"])
                    else:
                        family.add_metric([*labels, replica], value)
            yield family
