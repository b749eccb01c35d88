"""A route of inference over HTTP: its format answers requests, over ASGI or directly in the HTTP protocol."""

from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable
from time import perf_counter_ns
from typing import ClassVar, NamedTuple

from starlette.types import Receive, Scope, Send

from serve_app.access.access_control import KEY
from serve_app.access.access_log import LOG_ENTRY
from serve_app.access.request_body import BODY_READ, read_bytes
from serve_app.inference.serving import Serving
from serve_app.live_versions.traffic_split import Headers
from serve_app.runtime.timeouts import resume

REPLICA = b"x-league-replica"
"""Header of a response: the replica that has answered."""
ReadBody = Callable[[Scope, Receive, int], Awaitable[bytes]]
STARTED = "league.started"
"""Scope entry of a request that was started before it reached the application: its steps, and what they wait for."""
ResponseHeaders = tuple[tuple[bytes, bytes], ...]
JSON: ResponseHeaders = ((b"content-type", b"application/json"),)


class Reply(NamedTuple):
    """The response to a request. version: the one that has answered."""

    version: int
    body: bytes
    headers: ResponseHeaders = JSON
    """Without those of all routes."""


class HttpRoute(ABC):
    """A route as a plain ASGI application."""

    api: ClassVar[str]
    """Its name in metrics."""

    def __init__(self, serving: Serving, replica: str) -> None:
        self.serving = serving
        self._replica = (REPLICA, replica.encode())

    @abstractmethod
    async def answer(self, model: str, version: str, headers: Headers, body: bytes, begun: int) -> Reply:
        """Answer a request that was accepted.

        Args:
            model: `{league}` or `{league}.{policy}`.
            version: A number or an alias. It may be empty in the Open Inference Protocol: the champion.
            headers: Those of the request.
            body: Decompressed.
            begun: When the request began, a time of `perf_counter_ns`.

        Raises:
            LeagueError: The request is refused, or its policy fails.
        """

    async def respond(
        self, scope: Scope, receive: Receive, send: Send, version: str, read: ReadBody = read_bytes
    ) -> None:
        """Read a request, or continue one that was started, and send the response. Raises LeagueError."""
        start, access, model = perf_counter_ns(), self.serving.access, scope["path_params"]["model"]
        with self.serving.admitted(self.api):
            if (started := scope.pop(STARTED, None)) is not None:
                scope[BODY_READ] = True
                reply: Reply = await resume(*started)
            else:
                body = await read(scope, receive, self.serving.settings.max_body)
                access.admit_body(scope.get(KEY), len(body))
                reply = await self.answer(model, version, scope["headers"], body, start)
            if LOG_ENTRY in scope:
                scope[LOG_ENTRY] |= {"policy": model, "version": reply.version}
            headers = [*reply.headers, (b"content-length", b"%d" % len(reply.body)), self._replica]
            await send({"type": "http.response.start", "status": 200, "headers": headers})
            await send({"type": "http.response.body", "body": reply.body})
