"""Translates errors to HTTP responses with a status, a stable `code` and a message.

InvalidInput 400 (BodyTooLarge 413, UnsupportedMediaType 415, IllegalAction 422), Unauthenticated 401, Forbidden 403,
NotFound 404 (VersionRetired 410), BodyTooSlow 408, Conflict 409, Overloaded and RateLimited 429 with Retry-After,
RemoteError 502, NotReady, ArtifactCorrupt and StorageError 503 with Retry-After, DeadlineExceeded and GameHung 504,
others 500
"""

from collections.abc import Callable
from math import ceil
from typing import Any

import orjson
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Match

from league.errors import (
    ArtifactCorrupt,
    BodyTooLarge,
    Conflict,
    DeadlineExceeded,
    Forbidden,
    GameHung,
    IllegalAction,
    InvalidInput,
    LeagueError,
    NotFound,
    NotReady,
    Overloaded,
    RateLimited,
    RemoteError,
    StorageError,
    Unauthenticated,
    VersionRetired,
)
from serve_app.runtime.ray_serve import logger


class MalformedBody(InvalidInput, code="malformed_body"):
    """The body is not a JSON object."""


class UnsupportedMediaType(InvalidInput, code="unsupported_media_type"):
    """The Content-Type of the body is not JSON, or its Content-Encoding is not supported."""


class CrossSiteRequest(Forbidden, code="cross_site"):
    """A page of another origin sent the request."""


class UntrustedHost(Forbidden, code="untrusted_host"):
    """The request names a host other than the loopback interface, on a server without keys."""


class BodyTooSlow(LeagueError, code="body_too_slow"):
    """The body did not arrive in time."""


STATUSES: dict[type[LeagueError], int] = {
    BodyTooLarge: 413,
    UnsupportedMediaType: 415,
    IllegalAction: 422,
    InvalidInput: 400,
    Unauthenticated: 401,
    Forbidden: 403,
    NotFound: 404,
    VersionRetired: 410,
    BodyTooSlow: 408,
    Conflict: 409,
    Overloaded: 429,
    RateLimited: 429,
    RemoteError: 502,
    NotReady: 503,
    ArtifactCorrupt: 503,
    StorageError: 503,
    DeadlineExceeded: 504,
    GameHung: 504,
    LeagueError: 500,
}
"""HTTP status by class; the nearest ancestor of an error's class applies."""
CODES = {404: "unknown_path", 405: "method_not_allowed"}


def status_of(error: LeagueError) -> int:
    """The HTTP status of an error."""
    return next(STATUSES[ancestor] for ancestor in type(error).__mro__ if ancestor in STATUSES)


class ErrorHandlers:
    """Makes the responses to errors.

    retry: `Retry-After` of a 503, in seconds. count: called with the path and code of each error.
    """

    def __init__(self, retry: float, count: Callable[[str, str], None]) -> None:
        self._count = count
        self._headers = {
            401: {"www-authenticate": "Bearer"},
            408: {"connection": "close"},  # the rest of the body is not read
            429: {"retry-after": "1"},
            503: {"retry-after": str(max(1, round(retry)))},
        }

    def response(self, path: str, error: Exception) -> Response:
        """The error response to a request for `path`. The traceback of a bug goes to the log, not to the client."""
        if not isinstance(error, LeagueError):
            logger.error("a request failed", exc_info=error)
            self._count(path, "internal_error")
            return error_response(path, 500, "internal_error", "internal server error; see the server log")
        status = status_of(error)
        if status >= 500:
            logger.error("%s: %s", error.code, error)
        headers = self._headers.get(status)
        if isinstance(error, RateLimited):
            headers = {"retry-after": str(max(1, ceil(error.wait)))}
        self._count(path, error.code)
        return error_response(path, status, error.code, error.public_message, headers)

    async def http_error(self, request: Request, error: Exception) -> Response:
        """Starlette's exception handler for errors of the router."""
        assert isinstance(error, HTTPException)
        path, headers = request.url.path[:200], error.headers
        message = f"no route matches {path}" if error.status_code == 404 else error.detail
        if error.status_code == 405:
            # The router names the methods of the first route that matches the path, not of all.
            matching = (route for route in request.app.routes if route.matches(request.scope)[0] is Match.PARTIAL)
            methods = sorted({method for route in matching for method in route.methods})
            expected = " or ".join(method for method in methods if method != "HEAD")
            message = f"{request.method} is not allowed for {path}: use {expected}"
            headers = {"allow": ", ".join(methods)}
        code = CODES.get(error.status_code, "http_error")
        self._count(request.scope["path"], code)
        return error_response(request.scope["path"], error.status_code, code, message, headers)


def error_response(path: str, status: int, code: str, message: str, headers: Any = None) -> Response:
    """An error as JSON, in the format of the protocol that the path belongs to."""
    is_open_inference = path.startswith("/v2")
    body = orjson.dumps({"error": message} if is_open_inference else {"code": code, "message": message})
    return Response(body, status, headers, media_type="application/json")
