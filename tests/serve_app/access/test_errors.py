"""Each LeagueError has a status, and unexpected exceptions are not exposed."""

import pytest
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.routing import Route
from starlette.testclient import TestClient

from league import errors as league_errors
from league.errors import LeagueError, StorageError
from serve_app.access import errors
from serve_app.access.errors import ErrorHandlers

ERRORS = [
    error
    for module in (league_errors, errors)
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

    app = Starlette(
        routes=[Route("/", fail)], exception_handlers=ErrorHandlers(retry=3, count=lambda *_: None).handlers()
    )
    reply = TestClient(app, raise_server_exceptions=False).get("/")
    return reply.status_code, reply.json(), dict(reply.headers)


@pytest.mark.parametrize("error", ERRORS)
def test_an_error_has_the_status_of_its_class(error: type[LeagueError]) -> None:
    status, body, headers = answer(error("a sentence"))
    assert body == {"code": error.code, "message": error("a sentence").public_message}
    assert ("retry-after" in headers) == (status in (429, 503))
    for ancestor in error.__mro__:
        if ancestor.__name__ in EXPECTED:
            assert status == EXPECTED[ancestor.__name__]
            break


def test_paths_and_hosts_are_only_logged() -> None:
    error = StorageError("the database postgresql://admin@db.internal/league cannot be used: no route to host")
    _, body, _ = answer(error)
    assert body == {
        "code": "storage_error",
        "message": "the registry's database or files cannot be used; see the server log",
    }


def test_an_unexpected_exception_is_only_logged() -> None:
    status, body, _ = answer(ZeroDivisionError("secret"))
    assert (status, body["code"]) == (500, "internal_error")
    assert "secret" not in body["message"]
