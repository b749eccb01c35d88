"""The composition root that deploy.yaml names: one deployment whose replicas hold every served policy.

    HAProxy → replica: uvicorn → Ray Serve → the Starlette application below

Nothing stands behind the ingress: a request is answered in the process that it first reaches. Requests for actions do
without Ray Serve's part on that way (middleware.py).
"""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from functools import partial

from ray import serve
from ray.serve import Application
from starlette.applications import Starlette
from starlette.routing import Route

from league.registry.registry import Registry
from league.settings import Storage
from serve_app.alias_watcher import AliasWatcher
from serve_app.error_handlers import ErrorHandlers
from serve_app.live import Live
from serve_app.loading import load
from serve_app.middleware import shorten
from serve_app.models import Models
from serve_app.routes.action import ActionRoute
from serve_app.routes.health import HealthRoutes
from serve_app.routes.leagues import LeagueRoutes
from serve_app.settings import ServeSettings
from serve_app.versions import Versions


def build_app(args: ServeSettings) -> Application:
    """The Serve application. `args` in deploy.yaml are fields of ServeSettings."""
    deployment = serve.deployment(serve.ingress()(PolicyServer))
    return deployment.bind(args)


class PolicyServer:
    """One replica. Where its leagues live, LEAGUE_HOME and its siblings say."""

    def __init__(self, settings: ServeSettings) -> None:
        replica = serve.get_replica_context().replica_id.unique_id
        self._server = Server(Registry.open(Storage.from_environment()), settings, replica)

    def __serve_build_asgi_app__(self) -> Starlette:
        application = self._server.application()
        shorten(application)
        return application

    def check_health(self) -> None:
        """Ray Serve replaces a replica that no longer follows the registry."""
        if not self._server.watcher.is_ready:
            raise RuntimeError("the alias watcher has stopped")


class Server:
    """The parts of a replica, put together. Knows nothing of Ray."""

    def __init__(self, registry: Registry, settings: ServeSettings, replica: str) -> None:
        self.registry = registry
        self.settings = settings
        self.replica = replica
        self.versions = Versions(
            partial(load, registry, inline=settings.inline), settings.cached_versions, settings.retry
        )
        self.live = Live(self.versions)
        self.models = Models(registry, self.live, self.versions)
        self.watcher = AliasWatcher(registry, self.live, replica, settings)
        self.action = ActionRoute(self.models, settings, replica)

    def application(self) -> Starlette:
        """The ASGI application, which follows the registry's aliases while it runs."""
        leagues = LeagueRoutes(self.models)
        health = HealthRoutes(self.watcher, self.replica)
        return Starlette(
            routes=[
                Route("/v1/policies/{model}/action", self.action, methods=["POST"]),
                Route("/v1/leagues", leagues.leagues),
                Route("/v1/leagues/{league}", leagues.league),
                Route("/v1/leagues/{league}/versions", leagues.versions),
                Route("/v1/health/live", health.live),
                Route("/v1/health/ready", health.ready),
            ],
            exception_handlers=ErrorHandlers(self.settings.retry).table(),
            lifespan=self._running,
        )

    @asynccontextmanager
    async def _running(self, _: Starlette) -> AsyncIterator[None]:
        try:
            async with self.watcher.watching():
                yield
        finally:
            self.models.close()
            self.versions.close()
            self.registry.close()
