"""Requests bypass Ray Serve where possible, except those for its own paths."""

import pytest
from starlette.responses import PlainTextResponse
from starlette.testclient import TestClient
from starlette.types import Receive, Scope, Send

from serve_app.runtime import serve_bypass


@pytest.fixture
def client(monkeypatch: pytest.MonkeyPatch) -> TestClient:
    monkeypatch.setattr(serve_bypass, "_application", None)
    monkeypatch.setattr(serve_bypass, "_root_path", "")
    (outer,) = serve_bypass.middlewares()
    return TestClient(outer.cls(PlainTextResponse("serve"), *outer.args, **outer.kwargs))


@pytest.mark.parametrize(
    ("path", "handler"),
    [
        ("/v1/policies/board/action", "bypass"),
        ("/v2/models/board/infer", "bypass"),
        ("/v1/leagues/board/events", "bypass"),
        ("/v1/leagues", "bypass"),
        ("/v1/health/live", "bypass"),
        ("/", "bypass"),
        ("/-/healthz", "serve"),
        ("/-/routes", "serve"),
        ("/-/other", "bypass"),
    ],
)
def test_which_requests_bypass_ray_serve(client: TestClient, path: str, handler: str) -> None:
    serve_bypass.install(PlainTextResponse("bypass"))
    assert client.post(path).text == handler


async def echo(scope: Scope, receive: Receive, send: Send) -> None:
    await PlainTextResponse(f"{scope['path']} {scope['raw_path'].decode()}")(scope, receive, send)


@pytest.mark.parametrize(
    ("path", "seen"),
    [
        ("/ai/v1/policies/board/action", "/v1/policies/board/action /v1/policies/board/action"),
        ("/v1/policies/board/action", "/v1/policies/board/action /v1/policies/board/action"),
        ("/ai/v2/models/a%2Fb/infer", "/v2/models/a/b/infer /v2/models/a%2Fb/infer"),
        ("/ai/leagues/a%2Fb", "/leagues/a/b /leagues/a%2Fb"),
        ("/ai/", "/ /"),
        ("/ai", "/ /"),
        ("/ai/-/healthz", "serve"),
        ("/aims/v1/policies/board/action", "/aims/v1/policies/board/action /aims/v1/policies/board/action"),
        ("/v1/policies/ai/ai", "/v1/policies/ai/ai /v1/policies/ai/ai"),
    ],
)
def test_the_root_path_is_removed(client: TestClient, path: str, seen: str) -> None:
    serve_bypass.install(echo, "/ai")
    assert client.post(path).text == seen


def test_the_rest_of_the_server_sees_paths_without_the_root_path(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serve_bypass, "_application", None)
    monkeypatch.setattr(serve_bypass, "_root_path", "/ai")
    client = TestClient(serve_bypass.ServeBypass(echo))
    assert [client.get(path).text for path in ("/ai", "/ai/", "/ai/leagues/a%2Fb", "/aims")] == [
        "/ /",
        "/ /",
        "/leagues/a/b /leagues/a%2Fb",
        "/aims /aims",
    ]


def test_a_process_without_the_application_passes_requests_on(client: TestClient) -> None:
    assert client.post("/v1/policies/board/action").text == "serve"
