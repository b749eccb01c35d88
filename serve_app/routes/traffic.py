"""Sets the canary and shadow of a league, and reports their statistics.

    GET   /v1/leagues/{league}/traffic
    POST /v1/leagues/{league}/traffic  {"canary": {"version": "candidate", "share": 0.1}, "shadow": null, "reason": "…"}

`version` is a number or an alias. null removes the canary or shadow; an omitted one is unchanged. POST requires a key
of scope `promote` and an `Idempotency-Key`.
"""

from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field
from starlette.requests import Request
from starlette.responses import JSONResponse

from league.histograms import Histogram
from league.refs import MAX_VERSION, check_slug, parse_version
from league.registry.registry import Registry
from league.registry.storage.rows import Portion, ShadowCounts
from league.registry.traffic import KEEP, Unchanged
from serve_app.access.access_control import DEADLINE
from serve_app.access.request_body import MAX_CHANGE_BODY, read_body
from serve_app.models.resolver import ModelResolver
from serve_app.models.shadow import Shadow
from serve_app.observability.metrics import Metrics, Report
from serve_app.routes import documents, parsing


class VersionShare(BaseModel):
    """A version and its share of requests."""

    model_config = ConfigDict(extra="forbid", strict=True)

    version: Annotated[int, Field(ge=1, le=MAX_VERSION)] | str
    share: float = Field(ge=0, le=1)


class TrafficBody(parsing.ChangeBody):
    """The body of a change."""

    canary: VersionShare | None = None
    shadow: VersionShare | None = None


class TrafficRoutes:
    """The endpoints."""

    def __init__(self, models: ModelResolver, metrics: Metrics, shadow: Shadow, replica: str) -> None:
        self._models = models
        self._metrics = metrics
        self._shadow = shadow
        self._replica = replica

    async def show(self, request: Request) -> JSONResponse:
        """The setting, the replicas that apply it, and statistics of this replica and of all. Raises UnknownLeague."""
        league = check_slug("league", request.path_params["league"])
        shadowings = [one for one in self._shadow.shadowings() if one.league == league]
        replica_statistics = {"replica": self._replica} | _statistics(league, [self._metrics.report()], shadowings)
        document = await self._models.query(lambda registry: _document(registry, league))
        return JSONResponse(document | {"here": replica_statistics})

    async def put(self, request: Request) -> JSONResponse:
        """Set canary or shadow. Raises UnknownLeague, UnknownVersion, UnknownAlias, KeyReused or InvalidInput."""
        league = check_slug("league", request.path_params["league"])
        body = parsing.parse_body(TrafficBody, await read_body(request.scope, request.receive, MAX_CHANGE_BODY))
        canary = _portion(body.canary) if "canary" in body.model_fields_set else KEEP
        shadow = _portion(body.shadow) if "shadow" in body.model_fields_set else KEEP
        key, call = parsing.idempotent_call(request, body)
        setting = await self._models.change(
            lambda registry: registry.traffic.set(
                league, canary=canary, shadow=shadow, actor=key.name, reason=body.reason, call=call
            ),
            request.scope[DEADLINE],
        )
        return JSONResponse(documents.traffic_document(setting))


def shadow_document(shadowing: ShadowCounts) -> dict[str, Any]:
    """Statistics of a shadow as JSON; times are in milliseconds."""
    return {
        "candidate": shadowing.candidate,
        "champion": shadowing.champion,
        "requests": shadowing.requests,
        "observations": shadowing.observations,
        "agreed": shadowing.agreed,
        "agreement": shadowing.agreement,
        "failed": shadowing.failed,
        "dropped": shadowing.dropped,
        "skipped": shadowing.skipped,
        "latency_ms": _quantiles(Histogram(shadowing.latency, shadowing.ns)),
    }


def _portion(share: VersionShare | None) -> Portion | Unchanged | None:
    if share is None:
        return None
    return Portion(parse_version(str(share.version)), share.share)


def _document(registry: Registry, league: str) -> dict[str, Any]:
    setting = registry.traffic.current(league)
    acknowledgements = registry.replicas.acknowledgements(league)
    reports = list(registry.replicas.reports().values())
    replicas = [
        {"replica": one.replica, "follows": one.traffic == setting.id, "fault": one.fault} for one in acknowledgements
    ]
    statistics = _statistics(league, reports, registry.traffic.shadow_counts(league))
    return documents.traffic_document(setting) | {"replicas": replicas, "all": statistics}


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
        "shadows": [shadow_document(one) for one in shadowings],
    }


def _quantiles(histogram: Histogram) -> dict[str, float | None]:
    quantiles = {name: histogram.quantile(share) for name, share in (("p50", 0.5), ("p95", 0.95), ("p99", 0.99))}
    return {name: None if value == float("inf") else value for name, value in quantiles.items()}
