"""Every error of the kernel has a status, and a bug shows nothing of itself."""

import pytest
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.routing import Route
from starlette.testclient import TestClient

from league import errors
from league.errors import LeagueError
from serve_app import error_handlers
from serve_app.error_handlers import ErrorHandlers

ERRORS = [
    error
    for module in (errors, error_handlers)
    for error in vars(module).values()
    if isinstance(error, type) and issubclass(error, LeagueError)
]
EXPECTED = {
    "BodyTooLarge": 413,
    "UnsupportedMediaType": 415,
    "IllegalAction": 422,
    "Overloaded": 429,
    "InvalidInput": 400,
    "VersionRetired": 410,
    "NotFound": 404,
    "Conflict": 409,
    "NotReady": 503,
    "StorageError": 503,
    "GameHung": 504,
}


def answer(error: Exception) -> tuple[int, dict[str, str], dict[str, str]]:
    async def fail(_: Request) -> None:
        raise error

    app = Starlette(routes=[Route("/", fail)], exception_handlers=ErrorHandlers(retry=3, count=lambda *_: None).table())
    reply = TestClient(app, raise_server_exceptions=False).get("/")
    return reply.status_code, reply.json(), dict(reply.headers)


@pytest.mark.parametrize("error", ERRORS)
def test_an_error_has_the_status_of_its_class(error: type[LeagueError]) -> None:
    status, body, headers = answer(error("a sentence"))
    assert body == {"code": error.code, "message": "a sentence"}
    assert ("retry-after" in headers) == (status in (429, 503))
    for ancestor in error.__mro__:
        if ancestor.__name__ in EXPECTED:
            assert status == EXPECTED[ancestor.__name__]
            break


def test_a_bug_is_told_to_the_log_alone() -> None:
    status, body, _ = answer(ZeroDivisionError("secret"))
    assert (status, body["code"]) == (500, "internal_error")
    assert "secret" not in body["message"]
