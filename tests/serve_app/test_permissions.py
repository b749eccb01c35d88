"""What a request needs, for every route that there is and for those that there are not."""

import pytest
from starlette.routing import Route, WebSocketRoute

from league.registry.registry import Registry
from serve_app.app import Server
from serve_app.permissions import NOTHING, Need, of_request, of_rpc
from tests.serve_app.conftest import QUICK


@pytest.mark.parametrize(
    ("method", "path", "need"),
    [
        ("POST", "/v1/policies/board/action", Need("act", "board")),
        ("POST", "/v1/policies/duo.left/action", Need("act", "duo")),
        ("GET", "/v1/policies/board", Need("read", "board")),
        ("POST", "/v2/models/duo.left/infer", Need("act", "duo")),
        ("POST", "/v2/models/board/versions/3/infer", Need("act", "board")),
        ("GET", "/v2/models/board/versions/3/stats", Need("read", "board")),
        ("GET", "/v2/models/stats", Need("read", None, True)),
        ("POST", "/v2/repository/index", Need("read", None, True)),
        ("GET", "/v2", Need("read", None)),
        ("GET", "/docs", NOTHING),
        ("HEAD", "/openapi.json", NOTHING),
        ("POST", "/docs", Need("promote", None, True)),
        ("GET", "/docs/elsewhere", Need("read", None, True)),
        ("GET", "/", NOTHING),
        ("GET", "/leagues/board/verdicts", NOTHING),
        ("HEAD", "/pages/app.js", NOTHING),
        ("POST", "/leagues/board", Need("promote", None, True)),
        ("GET", "/leaguesque", Need("read", None, True)),
        ("GET", "/v1/leagues", Need("read", None, True)),
        ("GET", "/v1/leagues/board/versions", Need("read", "board")),
        ("PUT", "/v1/leagues/board/versions/3/note", Need("promote", "board", is_change=True)),
        ("HEAD", "/v1/leagues/board", Need("read", "board")),
        ("POST", "/v1/leagues/board/aliases/champion", Need("promote", "board", is_change=True)),
        ("POST", "/v1/leagues/board/rollback", Need("promote", "board", is_change=True)),
        ("POST", "/v1/leagues/board/evaluations", Need("evaluate", "board", is_change=True)),
        ("DELETE", "/v1/leagues/board/evaluations/3", Need("evaluate", "board", is_change=True)),
        ("GET", "/v1/leagues/board/evaluations/3", Need("read", "board")),
        ("PUT", "/v1/leagues/board/evaluations/3", Need("promote", "board")),
        ("POST", "/v1/leagues/board/play", Need("act", "board")),
        ("PUT", "/v1/leagues/board/play", Need("promote", "board")),
        ("POST", "/v1/leagues/play", Need("promote", "play")),
        ("GET", "/v1/leagues/board/playable", Need("read", "board")),
        ("GET", "/v1/leagues/board/matches/s/3/games/0/film.gif", Need("read", "board")),
        ("GET", "/v1/leagues/board/evaluations/3/events", Need("read", "board")),
        ("GET", "/v1/leagues/board/events", Need("read", "board")),
        ("GET", "/v1/leagues/board/aliases/champion/history", Need("read", "board")),
        ("GET", "/v1/leagues/board/matches/board-gauntlet-1/0", Need("read", "board")),
        ("POST", "/v1/leagues/board/verdicts/won", Need("promote", "board")),
        ("POST", "/v1/leagues/evaluations", Need("promote", "evaluations")),
        ("GET", "/v1/health/ready", NOTHING),
        ("GET", "/v2/health/live", NOTHING),
        ("GET", "/v1/key", NOTHING),
        ("POST", "/v1/key", Need("promote", None, True)),
        ("POST", "/v2/health/live", Need("promote", None, True)),
        ("GET", "/anything", Need("read", None, True)),
        ("DELETE", "/v1/leagues/board", Need("promote", "board")),
        ("POST", "//v1/leagues/board/rollback", Need("promote", None, True)),
        ("POST", "", Need("promote", None, True)),
    ],
)
def test_what_a_request_needs(method: str, path: str, need: Need) -> None:
    assert of_request("http", method, path) == need


def test_a_stream_acts() -> None:
    assert of_request("websocket", "GET", "/v1/policies/board/stream") == Need("act", "board")
    assert of_request("websocket", "GET", "/elsewhere") == Need("act", None, True)


@pytest.mark.parametrize(
    ("rpc", "model", "need"),
    [
        ("ServerLive", "", NOTHING),
        ("ServerReady", "", NOTHING),
        ("ServerMetadata", "", Need("read", None)),
        ("ModelReady", "board", Need("read", "board")),
        ("ModelInfer", "duo.left", Need("act", "duo")),
        ("ModelStatistics", "", Need("read", None, True)),
        ("RepositoryIndex", "", Need("read", None, True)),
    ],
)
def test_what_a_call_needs(rpc: str, model: str, need: Need) -> None:
    assert of_rpc(rpc, model) == need


def test_every_route_but_health_the_description_and_the_pages_needs_something(registry: Registry) -> None:
    for route in Server(registry, QUICK, "replica-1").application().routes:
        assert isinstance(route, Route | WebSocketRoute), "whoever mounts something thinks of its permissions here"
        kind = "websocket" if isinstance(route, WebSocketRoute) else "http"
        for method in getattr(route, "methods", None) or ("GET",):
            need = of_request(kind, method, route.path.replace("{", "").replace("}", ""))
            is_page = not getattr(route, "include_in_schema", True)
            is_open = is_page or "/health/" in route.path or route.path in ("/docs", "/openapi.json", "/v1/key")
            assert (need.scope is None) == is_open, route.path
            if "{league}" in route.path or "{model}" in route.path:
                assert need.league in ("league", "model"), route.path
