"""The short way to actions and streams, before Ray Serve's own handling of a request.

    HAProxy → uvicorn ┬→ /v1/policies/…, /v2/models/…, …/events  →  the application
                      └→ anything else                           →  Ray Serve → the application

What Serve does for each request (tasks that watch for a client that leaves, a request id, counting for its autoscaler,
metrics) takes as long as all the rest. An action needs none of it: it is computed before it could be given up, and the
route bounds its requests itself. Draining is uvicorn's: a server that stops finishes what it has begun, and closes
streams with 1012. Serve would wait for a stream of events as for any request, and nothing would tell that to end.

RAY_SERVE_HTTP_PROXY_CALLBACK_IMPORT_PATH names `middlewares`; without it everything goes the long way.
"""

import re

from starlette.middleware import Middleware
from starlette.types import ASGIApp, Receive, Scope, Send

ACTIONS = ("/v1/policies/", "/v2/models/")
"""Where actions, streams and inferences are asked for."""
EVENTS = re.compile("/v1/leagues/[^/]+/(evaluations/[^/]+/)?events")
"""Where streams of events are asked for."""
DIRECT = ("http", "websocket")
_application: ASGIApp | None = None


def shorten(application: ASGIApp) -> None:
    """Let requests for actions that reach this process go straight to `application`."""
    global _application
    _application = application


def middlewares() -> list[Middleware]:
    """The ASGI middlewares of every replica, and of Serve's own proxies, where there is nothing to shorten."""
    return [Middleware(ShortWay)]


class ShortWay:
    """Sends requests for actions to the application of this process, and all others on."""

    def __init__(self, onward: ASGIApp) -> None:
        self._onward = onward

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Choose the way."""
        if _application is not None and scope["type"] in DIRECT and _is_short(scope["path"]):
            await _application(scope, receive, send)
        else:
            await self._onward(scope, receive, send)


def lasts(path: str) -> bool:
    """Whether what is asked for is a stream of events, which has no end of its own."""
    return path.endswith("/events") and EVENTS.fullmatch(path) is not None


def _is_short(path: str) -> bool:
    return path.startswith(ACTIONS) or lasts(path)
