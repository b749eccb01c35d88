"""Bypasses Ray Serve's request path.

    HAProxy → uvicorn ┬→ SERVES_OWN → Ray Serve
                      └→ other paths → the application

Serve's work per request takes as long as everything else together, also for a caller who is then refused. The
application limits concurrency and time itself. A server that stops finishes requests in progress, ends event streams,
and closes WebSocket streams with 1012.

RAY_SERVE_HTTP_PROXY_CALLBACK_IMPORT_PATH names `middlewares`; without it, all requests go through Serve.
"""

from starlette.middleware import Middleware
from starlette.types import ASGIApp, Receive, Scope, Send

from serve_app.runtime.grpc_servers import limit_unknown_callers

SERVES_OWN = ("/-/healthz", "/-/routes")
"""Paths that Ray Serve answers itself; the first is HAProxy's health check."""
PROTOCOLS = ("http", "websocket")
_application: ASGIApp | None = None
_root_path = ""


def install(application: ASGIApp, root_path: str = "") -> None:
    """Send the requests of this process to `application`, and remove `root_path` from their paths."""
    global _application, _root_path
    _application, _root_path = application, root_path


def middlewares() -> list[Middleware]:
    """ASGI middlewares of every replica, and of Serve's own proxies, where nothing is installed.

    These processes call this before they start their gRPC servers.
    """
    limit_unknown_callers()
    return [Middleware(ServeBypass)]


class ServeBypass:
    """Sends requests to the application of this process, if it has one."""

    def __init__(self, onward: ASGIApp) -> None:
        self._onward = onward

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Dispatch a request."""
        is_request = scope["type"] in PROTOCOLS
        if _root_path and is_request:
            path, raw = scope["path"], scope["raw_path"]
            if (raw + b"/").startswith(_root_path.encode() + b"/"):  # a proxy may have removed it
                below, raw_below = path[len(_root_path) :] or "/", raw[len(_root_path) :] or b"/"
                scope = {**scope, "path": below, "raw_path": raw_below}
        if _application is not None and is_request and scope["path"] not in SERVES_OWN:
            await _application(scope, receive, send)
        else:
            await self._onward(scope, receive, send)
