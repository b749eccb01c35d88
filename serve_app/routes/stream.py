"""The WebSocket /v1/policies/{model}/stream: one message per step, for game servers and robots.

    ?version=N      pinned to that version, or to the one that an alias (default: champion) names at the handshake
    ?follow=ALIAS   each message is answered by the version that the alias names at that time

The connection answers messages within the call that received them (serve_app.runtime.uvicorn_websocket). A stream is
closed when its key becomes invalid, even if it receives no messages.

A change of the number of replicas reloads HAProxy, which cuts the streams that it forwards, all at once, two minutes
later. Streams are closed before, one after the other, so that their clients do not reconnect at the same moment.
"""

import asyncio
import random
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import NamedTuple

from starlette.types import Receive, Scope, Send

from league.errors import InvalidInput, Unauthenticated
from league.refs import CHAMPION, check_alias
from serve_app.access.access_control import KEY, POLICY_VIOLATION, SUBPROTOCOL
from serve_app.access.api_keys import ApiKey
from serve_app.access.connection_limit import ConnectionLimit, within_descriptors
from serve_app.declaration import ALIAS, CALLER, REPLICA_HEADER, VERSION, Declaration, Parameter
from serve_app.inference.http_route import REPLICA
from serve_app.inference.serving import Serving
from serve_app.inference.stream_session import StreamSession
from serve_app.live_versions.resolver import policy_ref, version_of
from serve_app.routes.query_string import query_params
from serve_app.runtime.background import in_background
from serve_app.runtime.ray_serve import logger
from serve_app.runtime.uvicorn_websocket import STREAM_PROTOCOL, StreamWebSocketProtocol

KEY_CHECK_INTERVAL = 1.0
"""Seconds between checks of the keys of open streams."""


class ClosingTimes(NamedTuple):
    """When streams are closed so that they reconnect: between `first` and `last` seconds from now."""

    first: float
    last: float


AFTER_CHANGE = ClosingTimes(10.0, 60.0)
"""HAProxy has been reloaded by then, so that streams reconnect through the new process. A replica that stops
deregisters up to 45 s after the reload, which cuts streams after 120 s (RAY_SERVE_HAPROXY_HARD_STOP_AFTER_S)."""
WHILE_DRAINING = ClosingTimes(5.0, 28.0)
"""Within the 30 s in which a replica that stops stays reachable (RAY_SERVE_DIRECT_INGRESS_MIN_DRAINING_PERIOD_S)."""
RECONNECT = "the number of replicas has changed: reconnect"


class StreamRoute:
    """The endpoint as a plain ASGI application. is_draining: whether this replica is being stopped."""

    def __init__(self, serving: Serving, replica: str, is_draining: Callable[[], bool] = lambda: False) -> None:
        self._serving = serving
        self._replica = replica
        self._is_draining = is_draining
        settings = serving.settings
        limit = within_descriptors(settings.max_streams)
        if limit < settings.max_streams:
            logger.warning(
                "max_streams is %d, but file descriptors suffice for %d streams: raise `ulimit -n`",
                settings.max_streams,
                limit,
            )
        self.connections = ConnectionLimit("streams", limit, settings.max_streams_per_key)
        self._accepted: dict[StreamWebSocketProtocol, ApiKey | None] = {}
        """The connections of open streams, and their keys."""
        self._closings: dict[StreamWebSocketProtocol, asyncio.TimerHandle] = {}
        self._replicas: int | None = None
        """Number of replicas at the last heartbeat."""

    @Declaration(
        "WEBSOCKET",
        "/v1/policies/{model}/stream",
        scope="act",
        tag="Inference",
        name="stream",
        success="The stream was opened.",
        status=101,
        headers=(
            REPLICA_HEADER,
            Parameter("x-league-version", {"type": "integer"}, "The version that serves the stream."),
            Parameter("x-league-sha256", {"type": "string"}, "The digest of the manifest of the version."),
        ),
        parameters=(VERSION, Parameter("follow", ALIAS, "The alias to follow, instead of `version`."), CALLER),
    )
    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Open a WebSocket for inference.

        A WebSocket (RFC 6455, no compression) for game servers and robots. Each message gets exactly one response, in
        order. The connection keeps the recurrent state. A page in a browser, which cannot set headers, offers the
        subprotocols `policy-league` and `policy-league.key.plk_…` with its API key; the server selects the first.

        The stream is pinned to `version`, or to the version that `champion` names when it is opened. With
        `follow={alias}` each message is served by the version that the alias names at that time; a recurrent policy
        switches at the start of an episode only.

        **JSON messages** have the fields of the action route, plus `reset: true` at the start of an episode and
        `return_state: true` to get a token. **Binary messages** have the header `<BBHIQ`: framing 1, flags (1 explore,
        2 seed, 4 reset, 8 a reset byte for each row, 16 greedy), 0, rows, seed. The inputs follow in the order of
        `GET /v2/models/{model}`. The response has the header `<BBHIII`: framing 1, 0, 0, rows, version, 0, followed by
        the actions. **Errors** are JSON with `code`, `message` and `status`; the stream stays open.

        Close codes: 1012, the replica is draining: reconnect to reach another one. 1008, the key was revoked. 1009, a
        message is too large.
        """
        await receive()  # the handshake
        with self.connections.opened(scope.get(KEY)):
            stream, headers = await self._create_session(scope)
            subprotocol = SUBPROTOCOL if SUBPROTOCOL in scope["subprotocols"] else None
            await send({"type": "websocket.accept", "subprotocol": subprotocol, "headers": headers})
            connection: StreamWebSocketProtocol = scope["extensions"][STREAM_PROTOCOL]
            self._accepted[connection] = scope.get(KEY)
            try:
                connection.set_handler(stream)
                await receive()  # the end
            finally:
                del self._accepted[connection]
                if (closing := self._closings.pop(connection, None)) is not None:
                    closing.cancel()

    def replicas_counted(self, number: int) -> None:
        """Called at each heartbeat with the number of replicas that are not being stopped.

        If it has changed, HAProxy has a new configuration, and the open streams reconnect. A replica that ends after it
        was drained changes nothing.
        """
        if self._replicas not in (None, number):
            self._reconnect(AFTER_CHANGE)
        self._replicas = number

    @asynccontextmanager
    async def checking(self) -> AsyncIterator[None]:
        """Close streams whose keys become invalid, or all if this replica is stopped, while the context is active."""
        async with in_background(self._check()):
            yield

    async def _check(self) -> None:
        while True:
            await asyncio.sleep(KEY_CHECK_INTERVAL)
            if self._is_draining():
                self._reconnect(WHILE_DRAINING)
            for connection, key in tuple(self._accepted.items()):
                try:
                    self._serving.access.check_key(key)
                except Unauthenticated as error:
                    # Not at once: a stream that cannot be closed must not prevent that others are.
                    asyncio.get_running_loop().call_soon(connection.end, POLICY_VIOLATION, str(error))

    def _reconnect(self, times: ClosingTimes) -> None:
        """Close the open streams at random times, or earlier if that was decided before."""
        loop = asyncio.get_running_loop()
        latest = loop.time() + times.last
        for connection in self._accepted:
            closing = self._closings.get(connection)
            if closing is not None and closing.when() <= latest:
                continue
            if closing is not None:
                closing.cancel()
            self._closings[connection] = loop.call_later(random.uniform(*times), connection.restart, RECONNECT)

    async def _create_session(self, scope: Scope) -> tuple[StreamSession, list[tuple[bytes, bytes]]]:
        model, query = scope["path_params"]["model"], query_params(scope)
        follows = query.get("follow")
        if follows is not None:
            check_alias(follows)
            if not isinstance(version_of(query.get("version", "1")), int):
                raise InvalidInput(f"version={query['version'][:64]!r} beside follow, expected a number")
        policy = await self._serving.models.find(model, follows or query.get("version", CHAMPION), scope["headers"])
        if follows is not None and "version" in query:
            # An episode continues after a reconnection with the same member of the mixture that the alias names.
            number, ref = version_of(query["version"]), policy_ref(model)
            named = self._serving.slots.get(ref.league, follows)
            members = () if named is None else named.members
            policy = next((member.policy(ref.policy) for member in members if member.number == number), policy)
        headers = {b"x-league-version": str(policy.number), b"x-league-sha256": policy.sha256, REPLICA: self._replica}
        stream = StreamSession(self._serving, model, policy, follows, scope["headers"], scope.get(KEY))
        return stream, [(name, value.encode()) for name, value in headers.items()]
