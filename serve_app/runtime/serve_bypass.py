"""Bypasses Ray Serve's request path for inference.

    HAProxy → uvicorn ┬→ /v1/policies/…, /v2/models/…, …/events → the application
                      └→ other paths → Ray Serve → the application

Serve's work per request takes as long as everything else together, and inference needs none of it: it finishes before
it could be cancelled, and the routes limit concurrency themselves. A server that stops finishes requests in progress
and closes streams with 1012. Event streams bypass Serve because it would wait for them to end.

RAY_SERVE_HTTP_PROXY_CALLBACK_IMPORT_PATH names `middlewares`; without it, all requests go through Serve.
"""

import re

from starlette.middleware import Middleware
from starlette.types import ASGIApp, Receive, Scope, Send

from serve_app.runtime.grpc_servers import limit_unknown_callers

INFERENCE_PREFIXES = ("/v1/policies/", "/v2/models/")
"""Paths of actions, streams and the Open Inference Protocol."""
EVENT_STREAM_PATH = re.compile("/v1/leagues/[^/]+/(evaluations/[^/]+/)?events")
"""Paths of event streams."""
PROTOCOLS = ("http", "websocket")
_application: ASGIApp | None = None
_root_path = ""


def install(application: ASGIApp, root_path: str = "") -> None:
    """Send requests that bypass Serve in this process to `application`, and remove `root_path` from all paths."""
    global _application, _root_path
    _application, _root_path = application, root_path


def middlewares() -> list[Middleware]:
    """ASGI middlewares of every replica, and of Serve's own proxies, where nothing is installed.

    These processes call this before they start their gRPC servers.
    """
    limit_unknown_callers()
    return [Middleware(ServeBypass)]


class ServeBypass:
    """Sends inference requests to the application of this process, and others to Ray Serve."""

    def __init__(self, onward: ASGIApp) -> None:
        self._onward = onward

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Dispatch a request."""
        if _root_path and scope["type"] in PROTOCOLS:
            scope = _below_root(scope)
        if _application is not None and scope["type"] in PROTOCOLS and _bypasses_serve(scope["path"]):
            await _application(scope, receive, send)
        else:
            await self._onward(scope, receive, send)


def is_event_stream(path: str) -> bool:
    """Whether a path is that of an event stream, which has no end of its own."""
    return path.endswith("/events") and EVENT_STREAM_PATH.fullmatch(path) is not None


def _below_root(scope: Scope) -> Scope:
    """A request without the root path, which a proxy may have removed."""
    path, raw = scope["path"], scope["raw_path"]
    if not (raw + b"/").startswith(_root_path.encode() + b"/"):
        return scope
    return {**scope, "path": path[len(_root_path) :] or "/", "raw_path": raw[len(_root_path) :] or b"/"}


def _bypasses_serve(path: str) -> bool:
    return path.startswith(INFERENCE_PREFIXES) or is_event_stream(path)
