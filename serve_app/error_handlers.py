"""Errors become HTTP answers here, once: a status, a stable `code`, and a sentence.

InvalidInput 400 (BodyTooLarge 413, UnsupportedMediaType 415) · NotFound 404 · Conflict 409
NotReady, ArtifactCorrupt, StorageError 503 with Retry-After · anything else 500
"""

import logging
from typing import Any

import orjson
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import Response

from league.errors import (
    ArtifactCorrupt,
    Conflict,
    InvalidInput,
    LeagueError,
    NotFound,
    NotReady,
    StorageError,
)

logger = logging.getLogger("ray.serve.policy_league")


class MalformedBody(InvalidInput):
    """A body that is not the JSON object that is expected."""

    code = "malformed_body"


class BodyTooLarge(InvalidInput):
    """A body, or a batch in it, beyond the limit."""

    code = "body_too_large"


class UnsupportedMediaType(InvalidInput):
    """A body that says that it is not JSON."""

    code = "unsupported_media_type"


class Overloaded(LeagueError):
    """More requests at once than a replica takes."""

    code = "overloaded"


STATUSES: dict[type[LeagueError], int] = {
    BodyTooLarge: 413,
    UnsupportedMediaType: 415,
    InvalidInput: 400,
    NotFound: 404,
    Conflict: 409,
    Overloaded: 429,
    NotReady: 503,
    ArtifactCorrupt: 503,
    StorageError: 503,
    LeagueError: 500,
}
"""The nearest class of an error's ancestors counts."""
CODES = {404: "unknown_path", 405: "method_not_allowed"}


class ErrorHandlers:
    """Starlette's exception handlers; a 503 asks to come back after `retry` seconds, a 429 after one."""

    def __init__(self, retry: float) -> None:
        self._headers = {429: {"retry-after": "1"}, 503: {"retry-after": str(max(1, round(retry)))}}

    def table(self) -> dict[Any, Any]:
        """Exception class → handler."""
        return {LeagueError: self.league_error, HTTPException: self.http_error, Exception: self.fault}

    async def league_error(self, _: Request, error: Exception) -> Response:
        """A fault that a person is told."""
        assert isinstance(error, LeagueError)
        status = next(STATUSES[ancestor] for ancestor in type(error).__mro__ if ancestor in STATUSES)
        if status >= 500:
            logger.error("%s: %s", error.code, error)
        return answer(status, error.code, str(error), self._headers.get(status))

    async def http_error(self, request: Request, error: Exception) -> Response:
        """What Starlette's router refuses."""
        assert isinstance(error, HTTPException)
        message = {
            404: f"there is nothing at {request.url.path[:200]}",
            405: f"{request.method} is not allowed at {request.url.path[:200]}",
        }.get(error.status_code, error.detail)
        return answer(error.status_code, CODES.get(error.status_code, "http_error"), message, error.headers)

    async def fault(self, _: Request, error: Exception) -> Response:
        """A bug. Its traceback is for the log, not for a stranger."""
        logger.error("a request failed", exc_info=error)
        return answer(500, "internal_error", "the server failed; its log says why")


def answer(status: int, code: str, message: str, headers: Any = None) -> Response:
    """An error as JSON."""
    body = orjson.dumps({"code": code, "message": message})
    return Response(body, status, headers, media_type="application/json")
