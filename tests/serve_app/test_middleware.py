"""Actions and what lasts go the short way where there is one; everything else goes through Ray Serve."""

import pytest
from starlette.responses import PlainTextResponse
from starlette.testclient import TestClient

from serve_app import middleware


@pytest.fixture
def client(monkeypatch: pytest.MonkeyPatch) -> TestClient:
    monkeypatch.setattr(middleware, "_application", None)
    (outer,) = middleware.middlewares()
    return TestClient(outer.cls(PlainTextResponse("long"), *outer.args, **outer.kwargs))


@pytest.mark.parametrize(
    ("path", "way"),
    [
        ("/v1/policies/board/action", "short"),
        ("/v2/models/board/infer", "short"),
        ("/v1/leagues/board/events", "short"),
        ("/v1/leagues/board/evaluations/3/events", "short"),
        ("/v1/leagues/events", "long"),
        ("/v1/leagues/board/aliases/events", "long"),
        ("/v1/leagues/board/evaluations", "long"),
        ("/v2/health/ready", "long"),
        ("/v1/leagues", "long"),
        ("/-/healthz", "long"),
    ],
)
def test_who_takes_the_short_way(client: TestClient, path: str, way: str) -> None:
    middleware.shorten(PlainTextResponse("short"))
    assert client.post(path).text == way


def test_a_process_without_the_application_passes_everything_on(client: TestClient) -> None:
    assert client.post("/v1/policies/board/action").text == "long"
