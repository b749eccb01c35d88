"""Sets the canary and shadow of a league, and reports their statistics."""

from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field
from starlette.requests import Request

from league.errors import UnknownAlias, UnknownVersion
from league.histograms import Histogram
from league.refs import MAX_VERSION, parse_version
from league.registry.registry import Registry
from league.registry.storage import rows
from league.registry.storage.idempotency import IdempotentCall
from league.registry.storage.rows import Portion, ShadowCounts
from league.registry.traffic import KEEP, Unchanged
from serve_app.access.api_keys import ApiKey
from serve_app.declaration import NUMBER_OR_ALIAS, Declaration, Response
from serve_app.live_versions.resolver import ModelResolver
from serve_app.live_versions.shadow import Shadow
from serve_app.observability.metrics import Metrics, Report
from serve_app.routes.documents import ChangeBody, Number, TrafficSetting


class VersionShare(BaseModel):
    """A version, and its share of requests."""

    model_config = ConfigDict(extra="forbid", strict=True)

    version: Annotated[int, Field(ge=1, le=MAX_VERSION)] | Annotated[str, Field(json_schema_extra=NUMBER_OR_ALIAS)] = (
        Field(description="The number of a version, or an alias.")
    )
    share: float = Field(ge=0, le=1)


class TrafficChange(ChangeBody):
    """A change of canary and shadow."""

    canary: VersionShare | None = None
    shadow: VersionShare | None = None


class FollowingReplica(Response):
    """A replica, and whether it has applied the setting."""

    replica: str
    follows: bool
    fault: str | None


class Latency(Response):
    """Upper bounds in milliseconds."""

    p50: float | None
    p95: float | None
    p99: float | None


class VersionTraffic(Response):
    """The requests that a version has answered."""

    version: Number
    requests: int
    as_canary: int
    latency_ms: Latency


class ShadowTraffic(Response):
    """A comparison of a shadow with the champion."""

    candidate: Number
    champion: Number
    requests: int
    observations: int
    agreed: int
    agreement: float | None
    failed: int
    dropped: int
    skipped: int
    latency_ms: Latency


class TrafficStatistics(Response):
    """Statistics of all replicas."""

    versions: list[VersionTraffic]
    shadows: list[ShadowTraffic]


class ReplicaStatistics(TrafficStatistics):
    """Statistics of one replica."""

    replica: str


class TrafficReport(TrafficSetting):
    """The setting of canary and shadow, and the statistics."""

    replicas: list[FollowingReplica]
    all: TrafficStatistics
    here: ReplicaStatistics


class TrafficRoutes:
    """The endpoint with the statistics of this replica."""

    def __init__(self, models: ModelResolver, metrics: Metrics, shadow: Shadow, replica: str) -> None:
        self._models = models
        self._metrics = metrics
        self._shadow = shadow
        self._replica = replica

    @Declaration("GET", "/v1/leagues/{league}/traffic", TrafficReport, scope="read", tag="Read")
    async def traffic(self, _: Request, league: str) -> dict[str, Any]:
        """Get canary and shadow traffic.

        The setting, the replicas that have applied it, and statistics of this replica (`here`) and of `all` replicas.
        """
        shadowings = [shadowing for shadowing in self._shadow.shadowings() if shadowing.league == league]
        statistics = {"replica": self._replica} | _statistics(league, [self._metrics.report()], shadowings)
        document = await self._models.in_registry_thread(lambda registry: _document(registry, league))
        return document | {"here": statistics}


@Declaration(
    "POST",
    "/v1/leagues/{league}/traffic",
    TrafficSetting,
    scope="promote",
    tag="Management",
    body=TrafficChange,
    errors=(UnknownVersion, UnknownAlias),
)
def set_traffic(
    registry: Registry, league: str, body: TrafficChange, key: ApiKey, call: IdempotentCall
) -> rows.Traffic:
    """Set canary and shadow traffic.

    Omitted fields stay unchanged; null removes a canary or a shadow.
    """
    canary = _portion(body.canary) if "canary" in body.model_fields_set else KEEP
    shadow = _portion(body.shadow) if "shadow" in body.model_fields_set else KEEP
    return registry.traffic.set(league, canary=canary, shadow=shadow, actor=key.name, reason=body.reason, call=call)


def _portion(share: VersionShare | None) -> Portion | Unchanged | None:
    if share is None:
        return None
    return Portion(parse_version(str(share.version)), share.share)


def _document(registry: Registry, league: str) -> dict[str, Any]:
    setting = registry.traffic.current(league)
    acknowledgements = registry.replicas.acknowledgements(league)
    reports = list(registry.replicas.reports().values())
    replicas = [
        {"replica": report.replica, "follows": report.traffic == setting.id, "fault": report.fault}
        for report in acknowledgements
    ]
    statistics = _statistics(league, reports, registry.traffic.shadow_counts(league))
    return TrafficSetting.model_validate(setting).model_dump() | {"replicas": replicas, "all": statistics}


def _statistics(league: str, reports: list[Report], shadowings: list[ShadowCounts]) -> dict[str, Any]:
    latencies: dict[int, Histogram] = {}
    canaried: dict[int, int] = {}
    for report in reports:
        for (of, _, version, _), value in report.get("league_request_seconds", ()):
            if of == league:
                ns = int(1e9 * value["sum"])
                latencies.setdefault(int(version), Histogram()).merge(value["counts"], ns)
        for (of, version), count in report.get("league_canary_requests_total", ()):
            if of == league:
                canaried[int(version)] = canaried.get(int(version), 0) + count
    return {
        "versions": [
            {
                "version": version,
                "requests": latency.count,
                "as_canary": canaried.get(version, 0),
                "latency_ms": _quantiles(latency),
            }
            for version, latency in sorted(latencies.items())
        ],
        "shadows": [
            {name: getattr(shadowing, name) for name in ShadowTraffic.model_fields if name != "latency_ms"}
            | {"latency_ms": _quantiles(Histogram(shadowing.latency, shadowing.ns))}
            for shadowing in shadowings
        ],
    }


def _quantiles(histogram: Histogram) -> dict[str, float | None]:
    quantiles = {name: histogram.quantile(share) for name, share in (("p50", 0.5), ("p95", 0.95), ("p99", 0.99))}
    return {name: None if value == float("inf") else value for name, value in quantiles.items()}
