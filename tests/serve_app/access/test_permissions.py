"""The permissions that requests need, for all routes and for unknown ones."""

import pytest
from starlette.routing import Route, WebSocketRoute

from league.registry.registry import Registry
from serve_app.access import permissions
from serve_app.access.permissions import PUBLIC, Permissions, RequiredPermission, for_rpc
from serve_app.app import Replica
from serve_app.routes.table import ROUTES
from tests.support.servers.replicas import QUICK

PERMISSIONS = Permissions(ROUTES)
for_request = PERMISSIONS.for_request


@pytest.mark.parametrize(
    ("method", "path", "need"),
    [
        ("POST", "/v1/policies/board/action", RequiredPermission("act", "board")),
        ("POST", "/v1/policies/duo.left/action", RequiredPermission("act", "duo")),
        ("GET", "/v1/policies/board", RequiredPermission("read", "board")),
        ("POST", "/v2/models/duo.left/infer", RequiredPermission("act", "duo")),
        ("POST", "/v2/models/board/versions/3/infer", RequiredPermission("act", "board")),
        ("GET", "/v2/models/board/versions/3/stats", RequiredPermission("read", "board")),
        ("GET", "/v2/models/stats", RequiredPermission("read", None, True)),
        ("POST", "/v2/repository/index", RequiredPermission("read", None, True)),
        ("GET", "/v2", RequiredPermission("read", None)),
        ("GET", "/docs", PUBLIC),
        ("HEAD", "/openapi.json", PUBLIC),
        ("POST", "/docs", RequiredPermission("promote", None, True)),
        ("GET", "/docs/elsewhere", RequiredPermission("read", None, True)),
        ("GET", "/", PUBLIC),
        ("GET", "/leagues/board/verdicts", PUBLIC),
        ("HEAD", "/pages/app.js", PUBLIC),
        ("POST", "/leagues/board", RequiredPermission("promote", None, True)),
        ("GET", "/leaguesque", RequiredPermission("read", None, True)),
        ("GET", "/v1/leagues", RequiredPermission("read", None, True)),
        ("GET", "/v1/leagues/board/versions", RequiredPermission("read", "board")),
        ("PUT", "/v1/leagues/board/versions/3/note", RequiredPermission("promote", "board", is_change=True)),
        ("HEAD", "/v1/leagues/board", RequiredPermission("read", "board")),
        ("POST", "/v1/leagues/board/aliases/champion", RequiredPermission("promote", "board", is_change=True)),
        ("POST", "/v1/leagues/board/rollback", RequiredPermission("promote", "board", is_change=True)),
        ("POST", "/v1/leagues/board/evaluations", RequiredPermission("evaluate", "board", is_change=True)),
        ("DELETE", "/v1/leagues/board/evaluations/3", RequiredPermission("evaluate", "board", is_change=True)),
        ("GET", "/v1/leagues/board/evaluations/3", RequiredPermission("read", "board")),
        ("PUT", "/v1/leagues/board/evaluations/3", RequiredPermission("promote", "board")),
        ("POST", "/v1/leagues/board/play", RequiredPermission("act", "board")),
        ("PUT", "/v1/leagues/board/play", RequiredPermission("promote", "board")),
        ("POST", "/v1/leagues/play", RequiredPermission("promote", "play")),
        ("GET", "/v1/leagues/board/playable", RequiredPermission("read", "board")),
        ("GET", "/v1/leagues/board/matches/s/3/games/0/video.gif", RequiredPermission("read", "board")),
        ("GET", "/v1/leagues/board/evaluations/3/events", RequiredPermission("read", "board", is_stream=True)),
        ("GET", "/v1/leagues/board/events", RequiredPermission("read", "board", is_stream=True)),
        ("HEAD", "/v1/leagues/board/events", RequiredPermission("read", "board", is_stream=True)),
        ("GET", "/v1/leagues/board/aliases/champion/history", RequiredPermission("read", "board")),
        ("GET", "/v1/leagues/board/matches/board-gauntlet-1/0", RequiredPermission("read", "board")),
        ("POST", "/v1/leagues/board/verdicts/won", RequiredPermission("promote", "board")),
        ("POST", "/v1/leagues/evaluations", RequiredPermission("promote", "evaluations")),
        ("GET", "/v1/health/ready", PUBLIC),
        ("GET", "/v2/health/live", PUBLIC),
        ("GET", "/v1/key", PUBLIC),
        ("POST", "/v1/key", RequiredPermission("promote", None, True)),
        ("POST", "/v2/health/live", RequiredPermission("promote", None, True)),
        ("GET", "/anything", RequiredPermission("read", None, True)),
        ("DELETE", "/v1/leagues/board", RequiredPermission("promote", "board")),
        ("POST", "//v1/leagues/board/rollback", RequiredPermission("promote", None, True)),
        ("POST", "", RequiredPermission("promote", None, True)),
    ],
)
def test_permissions_of_requests(method: str, path: str, need: RequiredPermission) -> None:
    assert for_request("http", method, path) == need


def test_a_stream_needs_the_permission_to_act() -> None:
    assert for_request("websocket", "GET", "/v1/policies/board/stream") == RequiredPermission("act", "board")
    assert for_request("websocket", "GET", "/elsewhere") == RequiredPermission("act", None, True)


@pytest.mark.parametrize(
    ("rpc", "model", "need"),
    [
        ("ServerLive", "", PUBLIC),
        ("ServerReady", "", PUBLIC),
        ("ServerMetadata", "", RequiredPermission("read", None)),
        ("ModelReady", "board", RequiredPermission("read", "board")),
        ("ModelInfer", "duo.left", RequiredPermission("act", "duo")),
        ("ModelStatistics", "", RequiredPermission("read", None, True)),
        ("RepositoryIndex", "", RequiredPermission("read", None, True)),
    ],
)
def test_permissions_of_rpcs(rpc: str, model: str, need: RequiredPermission) -> None:
    assert for_rpc(rpc, model) == need


def test_all_routes_but_health_documentation_and_pages_need_a_permission(registry: Registry) -> None:
    for route in Replica(registry, QUICK, "replica-1").application().routes:
        assert isinstance(route, Route | WebSocketRoute), "add the permissions of mounted applications"
        kind = "websocket" if isinstance(route, WebSocketRoute) else "http"
        for method in getattr(route, "methods", None) or ("GET",):
            need = for_request(kind, method, route.path.replace("{", "").replace("}", ""))
            is_page = not getattr(route, "include_in_schema", True)
            is_open = is_page or "/health/" in route.path or route.path in ("/docs", "/openapi.json", "/v1/key")
            assert (need.scope is None) == is_open, route.path
            if "{league}" in route.path or "{model}" in route.path:
                assert need.league in ("league", "model"), route.path


def test_long_paths_and_models_are_not_cached() -> None:
    """They come from requests without a key, too: 4096 of them would keep gigabytes."""
    sizes = [cached.cache_info().currsize for cached in (PERMISSIONS._cached, permissions._for_rpc)]
    path, model = f"/v1/leagues/{'x' * 300}", "x" * 300
    assert for_request("http", "GET", path) == RequiredPermission("read", "x" * 300)
    assert for_rpc("ModelReady", model) == RequiredPermission("read", model)
    assert [cached.cache_info().currsize for cached in (PERMISSIONS._cached, permissions._for_rpc)] == sizes
