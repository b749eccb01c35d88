"""Reports health, the permissions of the presented API key, and metrics for Prometheus."""

from typing import Any, Literal

from prometheus_client import CONTENT_TYPE_LATEST
from pydantic import Field
from starlette import responses
from starlette.requests import Request

from league.errors import NotReady, Unauthenticated
from league.registry.registry import Registry
from serve_app.access.access_control import AccessControl
from serve_app.declaration import Declaration, Response, Scope
from serve_app.live_versions.registry_watcher import RegistryWatcher
from serve_app.live_versions.resolver import ModelResolver
from serve_app.observability.prometheus import render

NO_REPLICA = ""
"""Replica of cluster-wide metrics: Prometheus treats an empty label as absent."""


class Health(Response):
    """The health of a replica."""

    status: Literal["live", "ready"]
    replica: str


class Key(Response):
    """An API key."""

    name: str
    scopes: list[Scope]
    leagues: list[str] | None = Field(description="The leagues of the key; null: all leagues.")


class PresentedKey(Response):
    """The permissions of the key; null without a key."""

    key: Key | None
    is_needed: bool = Field(description="Whether read access and inference require a key.")


class StatusRoutes:
    """The endpoints."""

    def __init__(self, models: ModelResolver, watcher: RegistryWatcher, access: AccessControl, replica: str) -> None:
        self._models = models
        self._watcher = watcher
        self._access = access
        self._replica = replica

    @Declaration("GET", "/v1/key", PresentedKey, scope=None, tag="Server", errors=(Unauthenticated,))
    async def key(self, request: Request) -> responses.Response:
        """Get the permissions of the API key.

        Public. Without a key, `is_needed` tells whether read access and inference require one. Changes always require a
        key.
        """
        key = self._access.presented_key(request.scope["headers"])
        key_document = key and {
            "name": key.name,
            "scopes": sorted(key.scopes),
            "leagues": None if key.leagues is None else sorted(key.leagues),
        }
        document = {"key": key_document, "is_needed": self._access.requires_key}
        return responses.JSONResponse(document, headers={"cache-control": "no-store"})

    @Declaration("GET", "/v1/health/live", Health, scope=None, tag="Server", success="The process responds.")
    async def live(self, _: Request) -> dict[str, Any]:
        """Liveness check."""
        return {"status": "live", "replica": self._replica}

    @Declaration(
        "GET",
        "/v1/health/ready",
        Health,
        scope=None,
        tag="Server",
        success="The replica follows the registry, and has loaded all live versions.",
        errors=(NotReady,),
    )
    async def ready(self, _: Request) -> dict[str, Any]:
        """Readiness check.

        The response is 200 once the versions that aliases name have been loaded, except those that fail to load.
        """
        if not self._watcher.is_ready:
            raise NotReady(f"replica {self._replica} has not loaded the registry's aliases yet")
        return {"status": "ready", "replica": self._replica}

    @Declaration(
        "GET",
        "/metrics",
        scope="read",
        tag="Server",
        success="Metrics in the Prometheus text format.",
        media=("text/plain",),
    )
    async def metrics(self, _: Request) -> responses.Response:
        """Get Prometheus metrics of all replicas.

        Counters never decrease when another replica answers the next scrape.
        """
        return responses.Response(await self._models.in_registry_thread(_metrics), media_type=CONTENT_TYPE_LATEST)


def _metrics(registry: Registry) -> bytes:
    counts = registry.evaluations.counts()
    samples = [[[league, state], count] for league, states in counts.items() for state, count in states.items()]
    of_cluster = {"league_evaluations": samples, "league_silent_replicas": [[[], len(registry.replicas.silent())]]}
    return render(registry.replicas.reports() | {NO_REPLICA: of_cluster})
