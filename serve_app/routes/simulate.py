"""The WebSocket /v1/leagues/{league}/simulate: relays the messages of a simulator to the process that needs episodes.

The caller is authenticated here, and the gateway checks the messages.
"""

import asyncio
from collections.abc import Callable
from typing import Literal

from pydantic import Field
from starlette.types import Receive, Scope, Send

from league.errors import NoSimulation, Unauthenticated
from league.refs import check_slug
from league.registry.registry import Registry
from league.registry.storage.rows import Gateway
from serve_app.access.access_control import KEY, POLICY_VIOLATION, SUBPROTOCOL, AccessControl
from serve_app.access.connection_limit import ConnectionLimit
from serve_app.declaration import Declaration, Response
from serve_app.live_versions.resolver import ModelResolver
from serve_app.runtime.simulator_relay import CloseFrame, connected, relay
from serve_app.runtime.uvicorn_websocket import SERVICE_RESTART
from serve_app.settings import ServeSettings

CHECK_INTERVAL = 1.0
"""Seconds between checks of the key of a simulator."""


class Simulation(Response):
    """A training run or an evaluation that needs episodes."""

    purpose: Literal["training", "evaluation"]
    simulators: int = Field(description="Number of simulators that are connected.")
    waiting: int = Field(description="Number of episodes that wait for one.")


class Simulations(Response):
    """What needs episodes of a league's simulators."""

    league: str
    simulations: tuple[Simulation, ...]


class SimulateRoute:
    """The endpoint as a plain ASGI application. is_draining: whether this replica is being stopped."""

    def __init__(
        self,
        models: ModelResolver,
        access: AccessControl,
        settings: ServeSettings,
        is_draining: Callable[[], bool] = lambda: False,
    ) -> None:
        self._models, self._access, self._is_draining = models, access, is_draining
        self.connections = ConnectionLimit("simulators", settings.max_streams, settings.max_streams_per_key)

    @Declaration(
        "WEBSOCKET",
        "/v1/leagues/{league}/simulate",
        scope="simulate",
        tag="Evaluations",
        name="simulate",
        success="The connection was opened.",
        status=101,
        errors=(NoSimulation,),
    )
    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Open a WebSocket for a simulator.

        A simulator is a game that runs in a program of its own. Through this WebSocket it receives episodes of a
        training run or an evaluation of the league, reports what agents observe, and receives their actions. The
        messages are described in the documentation, under "Simulators". If neither a run nor an evaluation needs
        episodes, the handshake is refused with `no_simulation`: connect again later. A page in a browser sends its API
        key as a subprotocol, as for streams.

        Close codes: 1012, connect again. 1007, the simulator has sent something invalid, which the last message
        describes. 1008, the key was revoked. 1011, the process that needed episodes has ended: connect again.
        """
        await receive()  # the handshake
        league, key = check_slug("league", scope["path_params"]["league"]), scope.get(KEY)
        with self.connections.opened(key):
            for candidate in await self._models.in_registry_thread(lambda registry: _gateways(registry, league)):
                if (gateway := await connected(candidate)) is not None:
                    break
            else:
                raise NoSimulation(f"neither a training run nor an evaluation of league {league} needs episodes now")
            async with gateway:
                subprotocol = SUBPROTOCOL if SUBPROTOCOL in scope["subprotocols"] else None
                await send({"type": "websocket.accept", "subprotocol": subprotocol, "headers": []})
                end = self._until_end(scope)
                await relay(scope, receive, send, gateway, end, lambda: self._access.admit_frame(key))

    @Declaration("GET", "/v1/leagues/{league}/simulations", Simulations, scope="simulate", tag="Evaluations")
    def simulations(self, registry: Registry, league: str) -> Simulations:
        """Show what needs episodes of simulators.

        In the order in which new simulators are sent there. The list is up to two seconds old.
        """
        gateways = _gateways(registry, league)
        return Simulations(league=league, simulations=tuple(map(Simulation.model_validate, gateways)))

    async def _until_end(self, scope: Scope) -> CloseFrame:
        """Wait until the key is invalid, or this replica is being stopped."""
        while True:
            await asyncio.sleep(CHECK_INTERVAL)
            if self._is_draining():
                return CloseFrame(SERVICE_RESTART, "the replica is draining: connect again")
            try:
                self._access.check_key(scope.get(KEY))
            except Unauthenticated as error:
                return CloseFrame(POLICY_VIOLATION, str(error)[:120])


def _gateways(registry: Registry, league: str) -> list[Gateway]:
    """The gateways of a league, in the order in which they need simulators. Raises UnknownLeague."""
    registry.leagues.get(league)
    return registry.gateways.open(league)
