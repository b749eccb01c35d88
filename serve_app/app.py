"""The composition root that deploy.yaml names: a deployment whose replicas hold every served policy, and the studio.

    HAProxy → replica: uvicorn → Ray Serve → the Starlette application below
                                               └ what needs an environment: → the studio, by handle

A request is answered in the process that it first reaches. Requests for actions do without Ray Serve's part on that way
(middleware.py).
"""

import gc
import sys
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from functools import partial
from importlib import import_module

import ray
from ray import serve
from ray.serve import Application
from ray.serve.handle import DeploymentHandle
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.routing import Route, WebSocketRoute

from league.errors import ConfigError
from league.registry.registry import Registry
from league.settings import Storage
from serve_app import http_protocol, websocket_protocol
from serve_app.access_log import AccessLog
from serve_app.alias_watcher import AliasWatcher
from serve_app.doors import Doors, Guarded
from serve_app.error_handlers import ErrorHandlers
from serve_app.events import Events
from serve_app.exposure import serves_other_machines
from serve_app.inference_protocol.catalogue import Catalogue
from serve_app.inference_protocol.grpc_handlers import offer
from serve_app.inference_protocol.grpc_service import InferenceService
from serve_app.inference_protocol.inference import Inference
from serve_app.inference_protocol.rest import RestRoutes
from serve_app.keyring import Keyring, KeyWatcher
from serve_app.live import Live
from serve_app.loading import load
from serve_app.metrics import Metrics
from serve_app.middleware import shorten
from serve_app.models import Models
from serve_app.reporting import Reporter
from serve_app.routes.action import ActionRoute, Shortcut
from serve_app.routes.docs import DocsRoutes
from serve_app.routes.evaluations import EvaluationRoutes
from serve_app.routes.events import EventRoutes
from serve_app.routes.games import GameRoutes
from serve_app.routes.health import HealthRoutes
from serve_app.routes.history import HistoryRoutes
from serve_app.routes.key import KeyRoute
from serve_app.routes.leagues import LeagueRoutes
from serve_app.routes.matches import MatchRoutes
from serve_app.routes.metrics import MetricsRoute
from serve_app.routes.notes import NoteRoutes
from serve_app.routes.pages import PageRoutes
from serve_app.routes.promotion import PromotionRoutes
from serve_app.routes.runs import RunRoutes
from serve_app.routes.standings import StandingsRoutes
from serve_app.routes.stream import StreamRoute
from serve_app.routes.traffic import TrafficRoutes
from serve_app.routes.verdicts import VerdictRoutes
from serve_app.settings import ServeSettings
from serve_app.shadow import Shadow
from serve_app.streams import StreamParts
from serve_app.studio import Studio, StudioHandle
from serve_app.traffic import Traffic
from serve_app.versions import Versions

LOOPBACK = "127.0.0.1"
GAME = "/v1/leagues/{league}/matches/{schedule}/{position}/games/{game}"
SWITCH = 0.0005
"""Seconds after which a thread that looks at the database, or computes a shadow, gives way to the event loop. Python's
default of 5 ms would be the time that the slowest requests wait."""


def build_app(args: ServeSettings) -> Application:
    """The Serve application. `args` in deploy.yaml are fields of ServeSettings."""
    deployment = serve.deployment(serve.ingress()(PolicyServer))
    return deployment.bind(args, _studio(args))


def _studio(args: ServeSettings) -> Application | None:
    """The deployment that plays games: found by its name, for a replica must load nothing of it. Raises ConfigError."""
    if args.studio is None:
        return None
    module, _, name = args.studio.partition(":")
    try:
        bound: Application = getattr(import_module(module), name)(args.evaluation_workers, args.evaluations_at_once)
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigError(f"deploy.yaml: args: studio {args.studio!r} cannot be imported: {error}") from error
    return bound


def _node_address() -> str:
    """The address by which Ray, and so HAProxy, knows this node."""
    here = ray.get_runtime_context().get_node_id()
    return str(next(node["NodeManagerAddress"] for node in ray.nodes() if node["NodeID"] == here))


class PolicyServer:
    """One replica. Where its leagues live, LEAGUE_HOME and its siblings say."""

    def __init__(self, settings: ServeSettings, studio: DeploymentHandle | None = None) -> None:
        sys.setswitchinterval(SWITCH)
        replica = serve.get_replica_context().replica_id.unique_id
        # A replica that starts while the database is elsewhere must not put an empty one into its place.
        registry = Registry.open(Storage.from_environment(), create=False)
        self._server = Server(
            registry,
            settings,
            replica,
            machine=_node_address(),
            is_exposed=serves_other_machines(),
            studio=studio and StudioHandle(studio, settings.timeout),
        )

    def __serve_build_asgi_app__(self) -> Starlette:
        application = self._server.application()
        shorten(application)
        http_protocol.install(self._server.events.end)
        websocket_protocol.install(self._server.settings.max_body)
        offer(self._server.inference_service)
        gc.freeze()  # what is loaded by now stays: looking through it again and again would stop the event loop
        return application

    def check_health(self) -> None:
        """Ray Serve replaces a replica that no longer follows the registry."""
        if not self._server.watcher.is_ready:
            raise RuntimeError("the alias watcher has stopped")


class Server:
    """The parts of a replica, put together. Knows nothing of Ray.

    `machine` is the address of its node; `is_exposed`: whether other machines reach it; `studio`: what plays games.
    """

    def __init__(
        self,
        registry: Registry,
        settings: ServeSettings,
        replica: str,
        machine: str = LOOPBACK,
        is_exposed: bool = False,
        studio: Studio | None = None,
    ) -> None:
        self.registry = registry
        self.settings = settings
        self.replica = replica
        self.versions = Versions(
            partial(load, registry, inline=settings.inline), settings.cached_versions, settings.retry
        )
        self.live = Live(self.versions)
        self.traffic = Traffic(self.live)
        self.access_log = _access_log(registry, settings, replica)
        self.shadow = Shadow(self.live, self.traffic, settings)
        self.metrics = Metrics(self.live, self.traffic, self.shadow)
        self.errors = ErrorHandlers(settings.retry, self.metrics.failed)
        self.models = Models(registry, self.live, self.versions, self.traffic)
        self.watcher = AliasWatcher(registry, self.live, self.traffic, replica, settings)
        self.keyring = Keyring()
        self.key_watcher = KeyWatcher(registry, self.keyring, settings)
        self.doors = Doors(self.keyring, settings, is_exposed)
        self.action = ActionRoute(self.models, self.shadow, self.metrics, settings, replica)
        parts = StreamParts(self.models, self.live, self.traffic, self.shadow, self.metrics, self.doors, settings)
        self.stream = StreamRoute(parts, replica)
        self.inference = Inference(self.models, self.shadow, self.metrics, settings)
        self.reporter = Reporter(registry, self.metrics, self.shadow, self._in_flight, replica, settings)
        self.evaluations = EvaluationRoutes(self.models, settings, studio)
        self.games = GameRoutes(self.models, settings, studio)
        self.events = Events(self.models, settings)
        self.catalogue = Catalogue(self.models, self.versions, self.inference, settings)
        self.inference_service = InferenceService(
            self.inference, self.catalogue, self.watcher, self.doors, settings, machine, self.metrics.failed
        )

    def _in_flight(self) -> dict[str, int]:
        return {
            "action": self.action.in_flight,
            "infer": self.inference.in_flight,
            "stream": self.stream.open,
            "events": self.events.open,
        }

    def application(self) -> Starlette:
        """The ASGI application, which follows the registry's aliases while it runs."""
        leagues = LeagueRoutes(self.models)
        standings = StandingsRoutes(self.models)
        verdicts = VerdictRoutes(self.models)
        matches = MatchRoutes(self.models)
        runs = RunRoutes(self.models)
        history = HistoryRoutes(self.models)
        promotion = PromotionRoutes(self.models, self.settings)
        notes = NoteRoutes(self.models, self.settings)
        traffic = TrafficRoutes(self.models, self.metrics, self.shadow, self.settings, self.replica)
        health = HealthRoutes(self.watcher, self.replica)
        events = EventRoutes(self.events, self.doors)
        docs = DocsRoutes(self.live, self.doors, self.settings)
        open_inference = RestRoutes(self.inference, self.catalogue, self.watcher, self.settings, self.replica)
        return Starlette(
            routes=[
                Route("/v1/policies/{model}/action", self.action, methods=["POST"]),
                WebSocketRoute("/v1/policies/{model}/stream", self.stream),
                *open_inference.routes(),
                Route("/v1/leagues", leagues.leagues),
                Route("/v1/leagues/{league}", leagues.league),
                Route("/v1/leagues/{league}/versions", leagues.versions),
                Route("/v1/leagues/{league}/versions/{version}/note", notes.put, methods=["PUT"]),
                Route("/v1/leagues/{league}/standings", standings.standings),
                Route("/v1/leagues/{league}/payoff", standings.payoff),
                Route("/v1/leagues/{league}/ratings", standings.ratings),
                Route("/v1/leagues/{league}/verdicts", verdicts.every),
                Route("/v1/leagues/{league}/verdicts/{verdict}", verdicts.one),
                Route("/v1/leagues/{league}/matches", matches.every),
                Route("/v1/leagues/{league}/matches/{schedule}/{position}", matches.one),
                Route("/v1/leagues/{league}/runs", runs.every),
                Route("/v1/leagues/{league}/runs/{run}", runs.one),
                Route("/v1/leagues/{league}/aliases/{alias}/history", history.history),
                Route("/v1/leagues/{league}/aliases/{alias}", promotion.move, methods=["POST"]),
                Route("/v1/leagues/{league}/rollback", promotion.roll_back, methods=["POST"]),
                Route("/v1/leagues/{league}/traffic", traffic.show),
                Route("/v1/leagues/{league}/traffic", traffic.put, methods=["POST"]),
                Route("/v1/leagues/{league}/evaluations", self.evaluations.every),
                Route("/v1/leagues/{league}/evaluations", self.evaluations.start, methods=["POST"]),
                Route("/v1/leagues/{league}/evaluations/{evaluation}", self.evaluations.one),
                Route("/v1/leagues/{league}/evaluations/{evaluation}", self.evaluations.stop, methods=["DELETE"]),
                Route("/v1/leagues/{league}/evaluations/{evaluation}/events", events.evaluation),
                Route("/v1/leagues/{league}/events", events.league),
                Route(GAME, self.games.recording),
                Route(f"{GAME}/film.gif", self.games.film),
                Route("/v1/leagues/{league}/playable", self.games.table),
                Route("/v1/leagues/{league}/play", self.games.play, methods=["POST"]),
                Route("/v1/key", KeyRoute(self.doors).key),
                Route("/docs", docs.docs),
                Route("/openapi.json", docs.openapi),
                Route("/metrics", MetricsRoute(self.models).metrics),
                Route("/v1/health/live", health.live),
                Route("/v1/health/ready", health.ready),
                *PageRoutes().routes(),
            ],
            middleware=[
                Middleware(Guarded, self.doors, self.errors, self.settings, self.access_log),
                Middleware(Shortcut, self.action),
            ],
            exception_handlers=self.errors.table(),
            lifespan=self._running,
        )

    @asynccontextmanager
    async def _running(self, _: Starlette) -> AsyncIterator[None]:
        try:
            async with AsyncExitStack() as running:
                if self.access_log is not None:
                    await running.enter_async_context(self.access_log.writing())
                await running.enter_async_context(self.key_watcher.watching())
                await running.enter_async_context(self.watcher.watching())
                await running.enter_async_context(self.reporter.reporting())
                await running.enter_async_context(self.events.watching())
                yield
        finally:
            self.shadow.close()
            self.models.close()
            self.versions.close()
            self.registry.close()


def _access_log(registry: Registry, settings: ServeSettings, replica: str) -> AccessLog | None:
    if settings.access_log is None:
        return None
    return AccessLog(registry.storage.home / settings.access_log, replica)
