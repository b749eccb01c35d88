"""Reports health, the permissions of the presented API key, and metrics for Prometheus."""

from prometheus_client import CONTENT_TYPE_LATEST
from starlette.requests import Request
from starlette.responses import JSONResponse, Response

from league.errors import NotReady
from league.registry.registry import Registry
from serve_app.access.access_control import AccessControl
from serve_app.models.registry_watcher import RegistryWatcher
from serve_app.models.resolver import ModelResolver
from serve_app.observability.metrics import Report
from serve_app.observability.prometheus import render

NO_REPLICA = ""
"""Replica of cluster-wide metrics: Prometheus treats an empty label as absent."""


class StatusRoutes:
    """GET /v1/health/live, /v1/health/ready, /v1/key and /metrics."""

    def __init__(self, models: ModelResolver, watcher: RegistryWatcher, access: AccessControl, replica: str) -> None:
        self._models = models
        self._watcher = watcher
        self._access = access
        self._replica = replica

    async def live(self, _: Request) -> JSONResponse:
        """200 while the process answers."""
        return JSONResponse({"status": "live", "replica": self._replica})

    async def ready(self, _: Request) -> JSONResponse:
        """200 once the versions that aliases name have been loaded, except those that fail to load. Raises NotReady."""
        if not self._watcher.is_ready:
            raise NotReady(f"replica {self._replica} has not loaded the registry's aliases yet")
        return JSONResponse({"status": "ready", "replica": self._replica})

    async def key(self, request: Request) -> JSONResponse:
        """The presented key's name, scopes and leagues (null for all), and whether other requests need a key.

        Needs no key. Raises Unauthenticated for an invalid one.
        """
        key = self._access.presented_key(request.scope["headers"])
        key_document = key and {
            "name": key.name,
            "scopes": sorted(key.scopes),
            "leagues": None if key.leagues is None else sorted(key.leagues),
        }
        headers = {"cache-control": "no-store"}
        return JSONResponse({"key": key_document, "is_needed": self._access.requires_key}, headers=headers)

    async def metrics(self, _: Request) -> Response:
        """The metrics of all replicas in the Prometheus text format. Raises StorageError.

        This replica's own come from the registry, too, so that counters never decrease when another replica answers
        the next scrape.
        """
        return Response(await self._models.query(_metrics), media_type=CONTENT_TYPE_LATEST)


def _metrics(registry: Registry) -> bytes:
    return render(registry.replicas.reports() | {NO_REPLICA: _cluster_report(registry)})


def _cluster_report(registry: Registry) -> Report:
    counts = registry.evaluations.counts()
    samples = [[[league, state], count] for league, states in counts.items() for state, count in states.items()]
    silent = len(registry.replicas.silent())
    return {"league_evaluations": samples, "league_silent_replicas": [[[], silent]]}
