"""All declared routes, in the order in which a request is compared with them."""

from serve_app.declaration import Declaration, declared
from serve_app.inference_protocol.rest import InferRoute, RestRoutes
from serve_app.routes import aliases, evaluations, leagues, nights, results, runs, traffic, verdicts
from serve_app.routes.action import ActionRoute
from serve_app.routes.evaluations import EvaluationRoutes
from serve_app.routes.events import EventRoutes
from serve_app.routes.games import GameRoutes
from serve_app.routes.pages import DocsRoutes, PageRoutes
from serve_app.routes.simulate import SimulateRoute
from serve_app.routes.status import StatusRoutes
from serve_app.routes.stream import StreamRoute
from serve_app.routes.traffic import TrafficRoutes

OF_REGISTRY = (leagues, results, verdicts, runs, nights, aliases, traffic, evaluations)
"""Modules with routes that need the registry only."""
OWNERS = (
    *(ActionRoute, StreamRoute, SimulateRoute, InferRoute, RestRoutes),
    *OF_REGISTRY,
    *(TrafficRoutes, EvaluationRoutes, EventRoutes, GameRoutes, StatusRoutes, DocsRoutes, PageRoutes),
)
ROUTES: list[Declaration] = [declaration for owner in OWNERS for declaration, _ in declared(owner)]
