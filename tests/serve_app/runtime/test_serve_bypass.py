"""Actions and streams bypass Ray Serve where possible; all other requests go through it."""

import pytest
from starlette.responses import PlainTextResponse
from starlette.testclient import TestClient

from serve_app.runtime import serve_bypass


@pytest.fixture
def client(monkeypatch: pytest.MonkeyPatch) -> TestClient:
    monkeypatch.setattr(serve_bypass, "_application", None)
    (outer,) = serve_bypass.middlewares()
    return TestClient(outer.cls(PlainTextResponse("serve"), *outer.args, **outer.kwargs))


@pytest.mark.parametrize(
    ("path", "handler"),
    [
        ("/v1/policies/board/action", "bypass"),
        ("/v2/models/board/infer", "bypass"),
        ("/v1/leagues/board/events", "bypass"),
        ("/v1/leagues/board/evaluations/3/events", "bypass"),
        ("/v1/leagues/events", "serve"),
        ("/v1/leagues/board/aliases/events", "serve"),
        ("/v1/leagues/board/evaluations", "serve"),
        ("/v2/health/ready", "serve"),
        ("/v1/leagues", "serve"),
        ("/-/healthz", "serve"),
    ],
)
def test_which_requests_bypass_ray_serve(client: TestClient, path: str, handler: str) -> None:
    serve_bypass.install(PlainTextResponse("bypass"))
    assert client.post(path).text == handler


def test_a_process_without_the_application_passes_requests_on(client: TestClient) -> None:
    assert client.post("/v1/policies/board/action").text == "serve"
