"""Errors become HTTP answers here, once: a status, a stable `code`, and a sentence.

InvalidInput 400 (BodyTooLarge 413, UnsupportedMediaType 415, IllegalAction 422) · Unauthenticated 401 · Forbidden 403
NotFound 404 (VersionRetired 410) · BodyTooSlow 408 · Conflict 409 · Overloaded, RateLimited 429 with Retry-After
NotReady, ArtifactCorrupt, StorageError 503 with Retry-After · DeadlineExceeded, GameHung 504 · anything else 500
"""

import logging
from collections.abc import Callable
from math import ceil
from typing import Any

import orjson
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import Response

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
    StorageError,
    Unauthenticated,
    VersionRetired,
)

logger = logging.getLogger("ray.serve.policy_league")


class MalformedBody(InvalidInput):
    """A body that is not the JSON object that is expected."""

    code = "malformed_body"


class UnsupportedMediaType(InvalidInput):
    """A body that says that it is not JSON."""

    code = "unsupported_media_type"


class CrossSite(Forbidden):
    """A request that a page of another site made."""

    code = "cross_site"


class BodyTooSlow(LeagueError):
    """A body that has not arrived in time."""

    code = "body_too_slow"


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
    NotReady: 503,
    ArtifactCorrupt: 503,
    StorageError: 503,
    DeadlineExceeded: 504,
    GameHung: 504,
    LeagueError: 500,
}
"""The nearest class of an error's ancestors counts."""
CODES = {404: "unknown_path", 405: "method_not_allowed"}


def status_of(error: LeagueError) -> int:
    """The HTTP status of an error."""
    return next(STATUSES[ancestor] for ancestor in type(error).__mro__ if ancestor in STATUSES)


class ErrorHandlers:
    """Starlette's exception handlers; a 503 asks to come back after `retry` seconds, a 429 after one.

    count: told the path and the code of each error.
    """

    def __init__(self, retry: float, count: Callable[[str, str], None]) -> None:
        self._count = count
        self._headers = {
            401: {"www-authenticate": "Bearer"},
            408: {"connection": "close"},  # what still comes of the body is not read
            429: {"retry-after": "1"},
            503: {"retry-after": str(max(1, round(retry)))},
        }

    def table(self) -> dict[Any, Any]:
        """Exception class → handler."""
        return {LeagueError: self.league_error, HTTPException: self.http_error, Exception: self.fault}

    async def league_error(self, request: Request, error: Exception) -> Response:
        """A fault that a person is told."""
        assert isinstance(error, LeagueError)
        return self.response(request.scope["path"], error)

    def response(self, path: str, error: LeagueError) -> Response:
        """The answer to a request for `path`."""
        status = status_of(error)
        if status >= 500:
            logger.error("%s: %s", error.code, error)
        headers = self._headers.get(status)
        if isinstance(error, RateLimited):
            headers = {"retry-after": str(max(1, ceil(error.wait)))}
        self._count(path, error.code)
        return answer(path, status, error.code, str(error), headers)

    async def http_error(self, request: Request, error: Exception) -> Response:
        """What Starlette's router refuses."""
        assert isinstance(error, HTTPException)
        message = {
            404: f"there is nothing at {request.url.path[:200]}",
            405: f"{request.method} is not allowed at {request.url.path[:200]}",
        }.get(error.status_code, error.detail)
        code = CODES.get(error.status_code, "http_error")
        self._count(request.scope["path"], code)
        return answer(request.scope["path"], error.status_code, code, message, error.headers)

    async def fault(self, request: Request, error: Exception) -> Response:
        """A bug. Its traceback is for the log, not for a stranger."""
        logger.error("a request failed", exc_info=error)
        self._count(request.scope["path"], "internal_error")
        return answer(request.scope["path"], 500, "internal_error", "the server failed; its log says why")


def answer(path: str, status: int, code: str, message: str, headers: Any = None) -> Response:
    """An error as JSON, in the form of the protocol that the path belongs to."""
    is_open_inference = path.startswith("/v2")
    body = orjson.dumps({"error": message} if is_open_inference else {"code": code, "message": message})
    return Response(body, status, headers, media_type="application/json")
