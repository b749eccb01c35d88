"""Composes a replica, and builds the Ray Serve application that deploy.yaml names.

    HAProxy → replica: uvicorn → the Starlette application below
                                   ├ requests that need an environment → the evaluation service, by handle
                                   └ requests for search versions → the search service, by handle

A request is answered in the process that it reaches first, and bypasses Ray Serve's request path
(serve_app.runtime.serve_bypass).
"""

import sys
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from functools import partial
from importlib import import_module

from ray import serve
from ray.serve import Application
from ray.serve.handle import DeploymentHandle
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.middleware.cors import CORSMiddleware
from starlette.middleware.exceptions import ExceptionMiddleware
from starlette.responses import RedirectResponse
from starlette.routing import Match, Router
from starlette.types import ASGIApp, Receive, Scope, Send

from league.errors import ConfigError
from league.ray_cluster import check_deployed_stack
from league.registry.registry import Registry
from league.settings import Storage
from league.stack import installed_with_this
from serve_app.access.access_control import AccessControl, AccessControlMiddleware
from serve_app.access.access_log import AccessLog
from serve_app.access.api_keys import ApiKeyCache
from serve_app.access.errors import ErrorHandlers
from serve_app.access.permissions import Permissions
from serve_app.evaluation_client import EvaluationClient, ServeEvaluationClient
from serve_app.inference import stream_session
from serve_app.inference.serving import Serving
from serve_app.inference_protocol import grpc_handlers, inference
from serve_app.inference_protocol.catalogue import ModelCatalogue
from serve_app.inference_protocol.grpc_service import InferenceService
from serve_app.inference_protocol.inference import Inference
from serve_app.inference_protocol.rest import InferRoute, RestRoutes
from serve_app.inference_protocol.statistics import REPORT
from serve_app.live_versions.alias_slots import AliasSlots
from serve_app.live_versions.policies import ActionSelections
from serve_app.live_versions.polling import Polling
from serve_app.live_versions.registry_connection import RegistryConnection
from serve_app.live_versions.registry_watcher import RegistryWatcher, WatchedState
from serve_app.live_versions.remote_search import SearchClient
from serve_app.live_versions.resolver import ModelResolver
from serve_app.live_versions.shadow import Shadow
from serve_app.live_versions.traffic_split import TrafficSplit
from serve_app.live_versions.version_cache import VersionCache, load
from serve_app.observability.load import LoadSampler
from serve_app.observability.metrics import Metrics, Report
from serve_app.observability.metrics_reporter import MetricsReporter
from serve_app.openapi.document import document
from serve_app.routes import action
from serve_app.routes.action import ActionRoute
from serve_app.routes.endpoints import routes_of
from serve_app.routes.evaluations import EvaluationRoutes
from serve_app.routes.events import EventBroker, EventRoutes
from serve_app.routes.games import GameRoutes
from serve_app.routes.inference_queue import InferenceQueue
from serve_app.routes.pages import DocsRoutes, PageRoutes
from serve_app.routes.simulate import SimulateRoute
from serve_app.routes.status import StatusRoutes
from serve_app.routes.stream import StreamRoute
from serve_app.routes.table import OF_REGISTRY, ROUTES
from serve_app.routes.traffic import TrafficRoutes
from serve_app.runtime import autoscaling, ray_serve, serve_bypass, uvicorn_http, uvicorn_websocket
from serve_app.runtime.replica_process import ReplicaProcess, collect_rarely, this_process
from serve_app.settings import ServeSettings

NAMES = {action.API: "act", stream_session.API: "stream", inference.API: "infer"}
"""Name of the route of each kind of inference request; gRPC counts as `infer`."""
PATHS = {route.name: route.path for route in ROUTES}
"""Path of each route, for Ray's metrics."""
SWITCH_INTERVAL = 0.0005
"""Thread switch interval in seconds. With Python's default of 5 ms, threads that query the database or compute a shadow
would delay the slowest requests by as much."""


def build_app(args: ServeSettings) -> Application:
    """The Serve application. `args` in deploy.yaml are fields of ServeSettings. Raises ConfigError."""
    evaluations = _bound(
        "evaluation_service", args.evaluation_service, args.evaluation_workers, args.evaluations_at_once
    )
    searches = _bound("search_service", args.search_service, args.search_processes)
    return serve.deployment(serve.ingress()(PolicyServer)).bind(args, evaluations, searches, installed_with_this())


def _bound(setting: str, service: str | None, *args: int) -> Application | None:
    """A deployment that a setting names. It is imported by name so that serve_app does not depend on it.

    Raises ConfigError.
    """
    if service is None:
        return None
    module, _, name = service.partition(":")
    try:
        application: Application = getattr(import_module(module), name)(*args)
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigError(f"deploy.yaml: args: {setting} {service!r} cannot be imported: {error}") from error
    return application


class PolicyServer(ray_serve.AsgiReplica):
    """The Ray Serve deployment: one replica. LEAGUE_HOME and related variables locate its leagues.

    stack: package → version with which the application was deployed. Raises ConfigError if this node has others.
    """

    def __init__(
        self,
        settings: ServeSettings,
        evaluation_service: DeploymentHandle | None,
        search_service: DeploymentHandle | None,
        stack: dict[str, str],
    ) -> None:
        check_deployed_stack(stack, ray_serve.node_address())
        sys.setswitchinterval(SWITCH_INTERVAL)
        ray_serve.load_proxy_classes_from_installed_code()
        # A replica that starts while the database is missing must not create an empty one.
        registry = Registry.open(Storage.from_environment(), create=False)
        self._replica = Replica(
            registry,
            settings,
            ray_serve.replica_id(),
            ray_serve.replica_process(),
            evaluation_service and ServeEvaluationClient(evaluation_service, settings.timeout),
            search_service and SearchClient(search_service, settings.search_processes),
        )
        self._load = LoadSampler(self._replica.metrics)
        self._count_requests = ray_serve.request_counter()

    def build(self) -> Starlette:
        """The application of this replica."""
        application = self._replica.application()
        serve_bypass.install(application, self._replica.settings.root_path)
        uvicorn_http.install(self._replica.events.end, self._replica.inference_queue)
        uvicorn_websocket.install(self._replica.settings.max_body, self._replica.settings.max_incomplete)
        grpc_handlers.install(self._replica.inference_service)
        collect_rarely()
        return application

    def check_health(self) -> None:
        """Called by Ray Serve, which replaces a replica that no longer follows the registry."""
        if not self._replica.watcher.is_ready:
            raise RuntimeError("the registry watcher has stopped")

    async def record_autoscaling_stats(self) -> dict[str, float]:
        """Called by Ray Serve at intervals. The statistics for the autoscaling policy and for Ray's own metrics."""
        sample = self._load.sample()
        if sample is None:
            return {}
        for api, count in sample.requests.items():
            self._count_requests(PATHS[NAMES[api]], count)
        return {autoscaling.LOAD: sample.load, ray_serve.RUNNING_REQUESTS: sample.in_progress}


class Replica:
    """The components of a replica. Independent of Ray.

    process: The process of the replica; by default this one, known by its machine.
    evaluation_client, search_client: None without the service.
    """

    def __init__(
        self,
        registry: Registry,
        settings: ServeSettings,
        replica: str,
        process: ReplicaProcess | None = None,
        evaluation_client: EvaluationClient | None = None,
        search_client: SearchClient | None = None,
    ) -> None:
        process = process or this_process()
        self.registry = registry
        self.settings = settings
        self.replica = replica
        selections = ActionSelections()
        self.versions = VersionCache(
            partial(
                load,
                registry,
                inline=settings.inline,
                selections=selections,
                timeout=min(settings.run_timeout, settings.timeout),
                search=search_client,
                load_timeout=settings.load_timeout,
            ),
            settings.cached_versions,
            settings.retry,
            settings.load_timeout,
        )
        self.alias_slots = AliasSlots(self.versions)
        self.traffic = TrafficSplit(self.alias_slots)
        self.access_log = (
            None if settings.access_log is None else AccessLog(registry.storage.home / settings.access_log, replica)
        )
        self.shadow = Shadow(self.alias_slots, self.traffic, settings)
        self.metrics = Metrics(self.alias_slots, self.traffic, self.shadow)
        self.errors = ErrorHandlers(settings.retry, self.metrics.count_error)
        self.models = ModelResolver(registry, self.alias_slots, self.versions, self.traffic)
        self.api_keys = ApiKeyCache()
        # Requests use connections of a pool, which are closed when there are none.
        self.connection = RegistryConnection(Registry.open(registry.storage, create=False, listens=True))
        self.watcher = RegistryWatcher(
            self.connection,
            WatchedState(self.alias_slots, self.traffic, selections, self.api_keys.update),
            replica,
            process,
            settings,
            on_heartbeat=registry.database.close_unused,
            on_replicas=lambda number: self.stream.replicas_counted(number),
        )
        self.access = AccessControl(self.api_keys, settings, Permissions(ROUTES), process.is_exposed)
        self.serving = Serving(
            self.models, self.alias_slots, self.traffic, self.shadow, self.metrics, self.access, settings
        )
        self.action = ActionRoute(self.serving, replica)
        self.inference = Inference(self.serving)
        # With an access log, the application answers all requests, and writes it.
        self.infer = InferRoute(self.inference, replica)
        self.inference_queue = (
            None if self.access_log else InferenceQueue(self.action, self.infer, self.errors, replica)
        )
        self.stream = StreamRoute(self.serving, replica, process.is_draining)
        self.simulate = SimulateRoute(self.models, self.access, settings, process.is_draining)
        self.reporter = MetricsReporter(self.connection, self.metrics, self.shadow, self._statistics, replica, settings)
        self._load = LoadSampler(self.metrics)
        self._evaluation_client = evaluation_client
        self._search_client = search_client
        self._evaluations = Polling(self._start_evaluations, "evaluations", settings.heartbeat, settings.poll_slowest)
        self.events = EventBroker(self.models, settings)
        self.catalogue = ModelCatalogue(self.models, self.versions, self.inference, settings, self.reporter.report)
        self.inference_service = InferenceService(
            self.inference, self.catalogue, self.watcher, self.access, settings, process.address
        )

    def _statistics(self) -> Report:
        sample = self._load.sample()
        in_flight = {
            action.API: self.serving.in_flight[action.API],
            inference.API: self.serving.in_flight[inference.API],
            "stream": self.stream.connections.open,
            "simulate": self.simulate.connections.open,
            "events": self.events.connections.open,
        }
        return {
            "league_requests_in_flight": [[[api], count] for api, count in in_flight.items()],
            REPORT: self.inference.statistics.documents(),
            "league_replica_load": [] if sample is None else [[[], sample.load]],
        }

    def application(self) -> Starlette:
        """The ASGI application, which follows the registry's aliases while it runs."""
        owners = (
            self.action,
            self.stream,
            self.simulate,
            self.infer,
            RestRoutes(self.inference, self.catalogue, self.watcher),
            *OF_REGISTRY,
            TrafficRoutes(self.models, self.metrics, self.shadow, self.replica),
            EvaluationRoutes(self.models, self.settings, self._evaluation_client),
            EventRoutes(self.events, self.access),
            GameRoutes(self.models, self._evaluation_client),
            StatusRoutes(self.models, self.watcher, self.access, self.replica),
            DocsRoutes(self.alias_slots, self.access, partial(document, self.settings)),
            PageRoutes(),
        )
        application = Starlette(
            routes=[route for owner in owners for route in routes_of(owner, self.models)], lifespan=self._running
        )
        _redirect_slashes(application.router)
        # Starlette's own stack has its middleware for bugs outermost, where it costs every request, and responses to
        # bugs lack the headers of the others.
        stack: ASGIApp = ExceptionMiddleware(application.router, {HTTPException: self.errors.http_error})
        stack = AccessControlMiddleware(stack, self.access, self.errors, self.settings, self.access_log)
        if origins := self.settings.cors_origins:
            stack = CORSMiddleware(
                stack, allow_origins=origins, allow_methods=("*",), allow_headers=("*",), expose_headers=("*",)
            )
        application.middleware_stack = stack
        return application

    async def _start_evaluations(self) -> None:
        """Start the evaluation service if there is something to do. Raises StorageError."""
        self._evaluations.mark_ready()
        if self._evaluation_client is not None and await self.connection.call(Registry.needs_evaluation_service):
            self._evaluation_client.notify()

    @asynccontextmanager
    async def _running(self, _: Starlette) -> AsyncIterator[None]:
        try:
            async with AsyncExitStack() as running:
                if self.access_log is not None:
                    await running.enter_async_context(self.access_log.writing())
                if self._search_client is not None:
                    await running.enter_async_context(self._search_client.running())
                await running.enter_async_context(self.watcher.watching())
                running.enter_context(self.shadow.comparing())
                await running.enter_async_context(self.reporter.reporting())
                await running.enter_async_context(self.events.watching())
                await running.enter_async_context(self.stream.checking())
                await running.enter_async_context(self._evaluations.running())
                yield
        finally:
            self.models.close()
            self.connection.close()
            self.registry.close()


def _redirect_slashes(router: Router) -> None:
    """Redirect `/docs/` to `/docs` by a relative reference. Starlette's own URLs lack the path prefix of a proxy."""
    not_found = router.default

    async def default(scope: Scope, receive: Receive, send: Send) -> None:
        path, raw = scope["path"], scope["raw_path"].decode("latin-1")
        without = {**scope, "path": path.removesuffix("/")}
        if raw.endswith("/") and any(route.matches(without)[0] is not Match.NONE for route in router.routes):
            query = scope["query_string"].decode("latin-1")
            url = f"../{raw[:-1].rpartition('/')[2]}{'?' * bool(query)}{query}"
            await RedirectResponse(url)(scope, receive, send)
        else:
            await not_found(scope, receive, send)

    router.redirect_slashes = False
    router.default = default
