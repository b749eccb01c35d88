"""Keys, permissions and origins of requests in all protocols, their error responses, and the access log.

Pages of other sites cannot change anything, even if no key is required; programs and our own pages can.
A server without keys on loopback answers only requests that name it so.
"""

import asyncio
import json
from collections.abc import AsyncIterator, Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any
from unittest.mock import AsyncMock, Mock

import httpx
import pytest
from starlette.routing import Route, WebSocketRoute
from starlette.testclient import TestClient, WebSocketDenialResponse
from starlette.types import Message
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Origin, Subprotocol

from league import errors as league_errors
from league.errors import LeagueError, Overloaded, StorageError
from league.registry.registry import Registry
from league.settings import Storage
from serve_app.access import api_keys, errors, permissions
from serve_app.access.api_keys import TokenBucket
from serve_app.access.errors import CrossSiteRequest, ErrorHandlers, UntrustedHost
from serve_app.access.load_shedding import Backlog
from serve_app.access.permissions import PUBLIC, Permissions, RequiredPermission, for_rpc
from serve_app.access.request_origin import reject_cross_site, reject_foreign_host
from serve_app.app import Replica
from serve_app.codecs.request_limits import LARGE_BODY
from serve_app.routes.table import ROUTES
from serve_app.runtime.haproxy_script import KEY_ACCEPTED
from serve_app.runtime.replica_process import this_process
from serve_app.settings import ServeSettings
from tests.support.clients.actions import BOARD, act, board_arrays, inference
from tests.support.servers.replicas import LOCALHOST, QUICK, local_client, replica
from tests.support.servers.streaming import listening
from tests.support.waiting import until

ACTION = "/v1/policies/board/action"
BODY = {"observation": BOARD}


def bearer(token: str) -> dict[str, str]:
    return {"authorization": f"Bearer {token}"}


@contextmanager
def serving_replica(registry: Registry, is_exposed: bool = False, **settings: Any) -> Iterator[TestClient]:
    """A replica's application, without Ray, with changed settings."""
    server = Replica(
        Registry.open(registry.storage),
        ServeSettings.model_validate(QUICK.model_dump() | settings),
        "replica-1",
        replace(this_process(), is_exposed=is_exposed),
    )
    with local_client(server) as client:
        yield client


def assert_rejected(reply: httpx.Response, status: int, code: str, *words: str) -> None:
    assert (reply.status_code, reply.json().get("code")) == (status, code), reply.text
    for word in words:
        assert word in reply.json()["message"]


def test_the_first_key_locks_the_server_and_its_revocation_does_not_unlock_it(
    client: TestClient, registry: Registry
) -> None:
    for headers in ({}, bearer("whatever")):
        assert client.post(ACTION, json=BODY, headers=headers).status_code == 200
    assert client.get("/v1/leagues").status_code == 200
    _, token = registry.keys.create("bot", ["act"])
    until(lambda: client.post(ACTION, json=BODY).status_code == 401)
    reply = client.post(ACTION, json=BODY)
    assert_rejected(reply, 401, "unauthenticated", "Authorization: Bearer")
    assert reply.headers["www-authenticate"] == "Bearer"
    assert client.post(ACTION, json=BODY, headers=bearer(token)).status_code == 200
    registry.keys.revoke("bot")
    until(lambda: client.post(ACTION, json=BODY, headers=bearer(token)).status_code == 401)
    assert_rejected(client.post(ACTION, json=BODY, headers=bearer(token)), 401, "unauthenticated", "revoked")
    assert client.post(ACTION, json=BODY).status_code == 401


def test_a_key_is_described_to_its_owner(client: TestClient, registry: Registry) -> None:
    assert client.get("/v1/key").json() == {"key": None, "is_needed": False}
    _, token = registry.keys.create("night-owl", ["read", "evaluate"], only_leagues=["board"])
    description = {"name": "night-owl", "scopes": ["evaluate", "read"], "leagues": ["board"]}
    until(lambda: client.get("/v1/key").json() == {"key": None, "is_needed": True})
    assert client.get("/v1/key", headers=bearer(token)).json() == {"key": description, "is_needed": True}
    assert_rejected(client.get("/v1/key", headers=bearer("plk_none")), 401, "unauthenticated", "unknown")


def test_haproxy_is_told_that_a_key_was_accepted(registry: Registry) -> None:
    _, token = registry.keys.create("bot", ["act"], rate=0.001)
    with serving_replica(registry) as client:
        assert KEY_ACCEPTED not in client.get("/docs", headers=bearer(token)).headers, "it needs no key"
        assert KEY_ACCEPTED not in client.get("/v1/leagues", headers=bearer(token)).headers, "another scope"
        assert client.post(ACTION, json=BODY, headers=bearer(token)).headers[KEY_ACCEPTED] == "1"
        refused = client.post(ACTION, json=BODY, headers=bearer(token))
        assert (refused.status_code, KEY_ACCEPTED in refused.headers) == (429, False)
        assert KEY_ACCEPTED not in client.post(ACTION, json=BODY, headers=bearer("x" * 47)).headers


def test_whether_keys_are_required(registry: Registry) -> None:
    """Not for health routes."""

    def statuses(require_keys: str, is_exposed: bool) -> list[int]:
        with serving_replica(registry, is_exposed, require_keys=require_keys) as client:
            for path in ("/v1/health/live", "/v1/health/ready", "/v2/health/live", "/v2/health/ready"):
                assert client.get(path).status_code == 200
            if (reply := client.get("/v1/leagues")).status_code != 200:
                assert_rejected(reply, 401, "unauthenticated", "league keys create NAME --scope read")
            return [client.post(ACTION, json=BODY).status_code, client.get("/v2/models/board").status_code]

    assert statuses("auto", is_exposed=False) == statuses("never", is_exposed=True) == [200, 200]
    assert statuses("auto", is_exposed=True) == statuses("always", is_exposed=False) == [401, 401]
    registry.keys.create("bot", ["act"])
    assert statuses("never", is_exposed=False) == [200, 200]


def test_a_key_is_limited_to_its_scope(registry: Registry) -> None:
    tokens = {scope: registry.keys.create(scope, [scope])[1] for scope in ("act", "read", "promote")}
    calls: dict[str, tuple[str, str]] = {
        "act": ("POST", ACTION),
        "read": ("GET", "/v1/leagues/board"),
        "promote": ("POST", "/v1/leagues/board/rollback"),
    }
    with serving_replica(registry) as client:
        for scope, token in tokens.items():
            for (needed, (method, path)), headers in product(
                calls.items(), ({"x-api-key": token}, {"authorization": f"bEARER {token}"})
            ):
                reply = client.request(method, path, json=BODY if needed == "act" else {}, headers=headers)
                if scope != needed:
                    assert_rejected(reply, 403, "forbidden", f"scope {needed}", f"the key {scope} has {scope}")
                else:
                    assert reply.status_code not in (401, 403), reply.text


def test_a_key_can_be_limited_to_leagues(registry: Registry) -> None:
    _, token = registry.keys.create("bot", ["act", "read"], only_leagues=["board", "duo"])
    with serving_replica(registry) as client:
        client.headers.update(bearer(token))
        assert client.post(ACTION, json=BODY).status_code == 200
        assert client.post("/v1/policies/duo.left/action", json=BODY).status_code == 200
        assert client.get("/v2/models/duo.left").status_code == 200
        assert client.get("/v2").status_code == 200
        assert_rejected(
            client.post("/v1/policies/vector/action", json={"observation": [0, 0]}), 403, "forbidden", "duo"
        )
        assert_rejected(client.get("/v1/leagues/vector"), 403, "forbidden", "another league")
        assert_rejected(client.get("/v1/leagues"), 403, "forbidden", "all leagues")
        assert client.get("/v2/models/vector").json() == {
            "error": "this request concerns another league; the key bot is restricted to board, duo"
        }
        assert client.get("/v2/models/stats").status_code == 403


def test_a_key_expires_without_a_registry_change(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    expires_at = datetime.now(UTC) + timedelta(days=1)
    _, token = registry.keys.create("bot", ["act"], expires_at=expires_at)
    with serving_replica(registry) as client:
        for seconds, status in ((-0.001, 200), (0, 401)):
            monkeypatch.setattr(api_keys, "time", lambda seconds=seconds: expires_at.timestamp() + seconds)
            assert client.post(ACTION, json=BODY, headers=bearer(token)).status_code == status


def test_a_rate_limit_is_enforced(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    """A large body counts as several requests."""
    monkeypatch.setattr(api_keys, "TokenBucket", partial(TokenBucket, clock=lambda: 0.0))  # no time passes
    rates = {"slow": 0.5, "large": 0.5, "fast": None}
    tokens = {name: registry.keys.create(name, ["act"], rate=rate)[1] for name, rate in rates.items()}
    large = json.dumps(BODY).encode() + b" " * LARGE_BODY
    with serving_replica(registry) as client:
        assert client.post(ACTION, json=BODY, headers=bearer(tokens["slow"])).status_code == 200
        assert client.post(ACTION, content=large, headers=bearer(tokens["large"])).status_code == 413
        for name, seconds in (("slow", "2"), ("large", "4")):
            reply = client.post(ACTION, json=BODY, headers=bearer(tokens[name]))
            message = f"rate limit exceeded: the key {name} allows 0.5 requests per second"
            assert_rejected(reply, 429, "rate_limited", message)
            assert reply.headers["retry-after"] == seconds
        for _ in range(20):
            assert client.post(ACTION, json=BODY, headers=bearer(tokens["fast"])).status_code == 200


def test_a_body_is_admitted_when_it_has_arrived(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    """Otherwise clients could open many requests, and send all bodies at the same time."""
    server, send = Replica(Registry.open(registry.storage), QUICK, "replica-1"), AsyncMock()
    admissions: list[str] = []
    monkeypatch.setattr(Backlog, "admit", lambda _: admissions.append("body"))

    async def receive() -> Message:
        assert not admissions
        return {"type": "http.request", "body": json.dumps(BODY).encode()}

    scope = {"type": "http", "method": "POST", "headers": [], "query_string": b"", "path_params": {"model": "board"}}
    with local_client(server) as client:
        assert client.portal is not None
        client.portal.call(server.action, scope, receive, send)
    assert (send.await_args_list[0].args[0]["status"], admissions) == (200, ["body"])


def test_a_rejected_stream_has_an_error_response(registry: Registry) -> None:
    _, token = registry.keys.create("bot", ["read"])
    with serving_replica(registry) as client:
        for headers, status, code in (({}, 401, "unauthenticated"), (bearer(token), 403, "forbidden")):
            stream = client.websocket_connect("/v1/policies/board/stream", headers=headers)
            with pytest.raises(WebSocketDenialResponse) as caught, stream:
                pass
            assert (caught.value.status_code, caught.value.json()["code"]) == (status, code)


def test_known_keys_are_valid_while_the_database_is_unreachable(registry: Registry) -> None:
    _, token = registry.keys.create("bot", ["act"])
    server = Replica(Registry.open(registry.storage), QUICK, "replica-1")
    with local_client(server) as client:
        server.registry.database.close()
        registry.storage.home.rename(registry.storage.home.with_name("elsewhere"))
        assert client.post(ACTION, json=BODY, headers=bearer(token)).status_code == 200
        assert client.post(ACTION, json=BODY).status_code == 401
        registry.storage.home.with_name("elsewhere").rename(registry.storage.home)


def test_a_persistent_queue_is_shed(read_only_client: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Backlog, "admit", Mock(side_effect=Overloaded("more than 64 requests wait here already")))
    for path in (ACTION, "/v2/models/board/infer"):
        reply = read_only_client.post(path, json=BODY)
        assert (reply.status_code, reply.headers["retry-after"]) == (429, "1")
    assert read_only_client.get("/v1/leagues").status_code == 200, "only actions are shed"


def test_an_invalid_time_limit_is_rejected(read_only_client: TestClient) -> None:
    for value in ("", "0", "-5", "1.5", "soon", "9" * 30, "٣"):
        headers: Any = [(b"x-request-timeout-ms", value.encode())]
        reply = read_only_client.post(ACTION, json=BODY, headers=headers)
        assert_rejected(reply, 400, "invalid_input", "x-request-timeout-ms")
    assert read_only_client.post(ACTION, json=BODY, headers={"x-request-timeout-ms": "4000"}).status_code == 200


# Their inference runs on the event loop, so that it is not interrupted by the timeout.
IMPATIENT = ServeSettings.model_validate(QUICK.model_dump() | {"timeout": 0.05, "inline": 10.0})


@pytest.mark.anyio
async def test_a_response_that_is_not_read_is_not_started_twice(registry: Registry) -> None:
    server = Replica(registry, IMPATIENT, "replica-1")
    application = server.application()
    sent: list[str] = []

    async def receive() -> dict[str, Any]:
        return {"type": "http.request", "body": json.dumps(BODY).encode(), "more_body": False}

    async def send(message: Any) -> None:
        sent.append(message["type"])
        if message["type"] == "http.response.body":
            await asyncio.Event().wait()

    scope = {"type": "http", "method": "POST", "path": ACTION, "query_string": b"", "headers": []}
    async with application.router.lifespan_context(application):
        await application(scope, receive, send)
    assert sent == ["http.response.start", "http.response.body"]
    assert server.serving.in_flight["action"] == 0


@pytest.mark.anyio
async def test_a_body_that_does_not_arrive_times_out(registry: Registry) -> None:
    server = Replica(registry, IMPATIENT, "replica-1")
    application = server.application()

    async def slow_body() -> AsyncIterator[bytes]:
        yield b'{"observation": '
        await asyncio.Event().wait()

    async with application.router.lifespan_context(application):
        transport = httpx.ASGITransport(app=application)
        async with httpx.AsyncClient(transport=transport, base_url=LOCALHOST) as client:
            for path in (ACTION, "/v2/models/board/infer"):
                reply = await client.post(path, content=slow_body())
                assert (reply.status_code, reply.headers["connection"]) == (408, "close")
            assert (await client.post(ACTION, json=BODY)).status_code == 200
    assert server.serving.in_flight["action"] == 0


@pytest.mark.anyio
@pytest.mark.parametrize(("limit", "requested"), [(4.5, "50"), (0.05, "60000")], ids=["requested", "of the server"])
async def test_a_slow_response_times_out(
    registry: Registry, monkeypatch: pytest.MonkeyPatch, limit: float, requested: str
) -> None:
    """A client can only shorten the timeout of the server."""
    server = Replica(registry, ServeSettings.model_validate(QUICK.model_dump() | {"timeout": limit}), "replica-1")
    application = server.application()

    async def never_finish(*_: Any) -> None:
        await asyncio.Event().wait()

    async with application.router.lifespan_context(application):
        monkeypatch.setattr(server.models, "find", never_finish)
        transport = httpx.ASGITransport(app=application)
        async with httpx.AsyncClient(transport=transport, base_url=LOCALHOST) as client:
            reply = await client.post(ACTION, json=BODY, headers={"x-request-timeout-ms": requested})
            assert_rejected(reply, 504, "deadline_exceeded", "0.05 s")


LOGGING_SETTINGS = QUICK.model_copy(update={"access_log": "logs"})


@pytest.fixture
def log(registry: Registry) -> Path:
    return registry.storage.home / "logs" / "access-replica-1.jsonl"


def lines(log: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in log.read_text().splitlines()]


def test_each_request_is_a_line(registry: Registry, log: Path) -> None:
    _, token = registry.keys.create("game-server", ["act"])
    with replica(registry.storage, LOGGING_SETTINGS) as client:
        client.headers.update(bearer(token))
        act(client, version=2, observation=BOARD)
        client.post("/v2/models/board/versions/3/infer", json=inference(board_arrays([BOARD])))
        client.post(ACTION, json={})
        client.get("/v1/leagues")
        client.post(ACTION, headers=bearer("nothing"))
        client.get("/v1/health/live")
    logged = lines(log)
    assert [[line[name] for name in ("method", "route", "policy", "version", "status", "key")] for line in logged] == [
        ["POST", ACTION, "board", 2, 200, "game-server"],
        ["POST", "/v2/models/board/versions/3/infer", "board", 3, 200, "game-server"],
        ["POST", ACTION, None, None, 400, "game-server"],
        ["GET", "/v1/leagues", None, None, 403, None],
        ["POST", ACTION, None, None, 401, None],
        ["GET", "/v1/health/live", None, None, 200, None],
    ]
    assert all(line["us"] > 0 and line["time"].endswith("Z") for line in logged)
    assert token not in log.read_text()


def test_a_bug_is_answered_logged_counted_and_raised(
    registry: Registry, log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, token = registry.keys.create("player", ["act", "read"])
    headers = bearer(token) | {"origin": GAME}
    settings = LOGGING_SETTINGS.model_copy(update={"cors_origins": [GAME]})
    server = Replica(Registry.open(registry.storage), settings, "replica-1")
    application = server.application()
    with TestClient(application, base_url=LOCALHOST, raise_server_exceptions=False) as client:
        for name in ("in_registry_thread", "find"):
            monkeypatch.setattr(server.models, name, None)
        replies = [client.get("/v1/leagues", headers=headers), client.post(ACTION, json=BODY, headers=headers)]
        for reply in replies:
            assert_rejected(reply, 500, "internal_error", "see the server log")
            assert reply.headers["access-control-allow-origin"] == GAME, "a page can read it"
        with pytest.raises(TypeError):
            TestClient(application, base_url=LOCALHOST).post(ACTION, json=BODY, headers=headers)
        counts = server.metrics.report()["league_errors_total"]
        assert sum(count for labels, count in counts if "internal_error" in labels) == 3
    assert [line["status"] for line in lines(log)] == [500, 500, 500]


def test_requests_succeed_if_the_log_cannot_be_written(registry: Registry, log: Path) -> None:
    log.parent.write_text("a file where the directory should be")
    with replica(registry.storage, LOGGING_SETTINGS) as client:
        for _ in range(3):
            act(client, observation=BOARD)
    log.parent.unlink()
    with replica(registry.storage) as client:
        act(client, observation=BOARD)
    assert not log.exists(), "by default nothing is logged"


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
    reply = ErrorHandlers(retry=3, count=lambda *_: None).response("/", error)
    return reply.status_code, json.loads(reply.body), dict(reply.headers)


def test_an_error_has_the_status_of_its_class(subtests: pytest.Subtests) -> None:
    for error in ERRORS:
        with subtests.test(error.__name__):
            status, body, headers = answer(error("a sentence"))
            assert body == {"code": error.code, "message": error("a sentence").public_message}
            assert ("retry-after" in headers) == (status in (429, 503))
            statuses = [EXPECTED[ancestor.__name__] for ancestor in error.__mro__ if ancestor.__name__ in EXPECTED]
            assert statuses[:1] in ([], [status])


def test_paths_hosts_and_unexpected_exceptions_are_only_logged() -> None:
    error = StorageError("the database postgresql://admin@db.internal/league cannot be used: no route to host")
    message = "the registry's database or files cannot be used; see the server log"
    assert answer(error)[1] == {"code": "storage_error", "message": message}
    status, body, _ = answer(ZeroDivisionError("secret"))
    assert (status, body["code"], "secret" in body["message"]) == (500, "internal_error", False)


PERMISSIONS = Permissions(ROUTES)
for_request = PERMISSIONS.for_request
needs = RequiredPermission


READ_ALL, CHANGE_ALL = needs("read", None, True), needs("promote", None, True)
REQUESTS = (
    ("POST", "/v1/policies/board/action", needs("act", "board")),
    ("POST", "/v1/policies/duo.left/action", needs("act", "duo")),
    ("GET", "/v1/policies/board", needs("read", "board")),
    ("POST", "/v2/models/duo.left/infer", needs("act", "duo")),
    ("POST", "/v2/models/board/versions/3/infer", needs("act", "board")),
    ("GET", "/v2/models/board/versions/3/stats", needs("read", "board")),
    ("GET", "/v2/models/stats", READ_ALL),
    ("POST", "/v2/repository/index", READ_ALL),
    ("GET", "/v2", needs("read", None)),
    ("GET", "/docs", PUBLIC),
    ("HEAD", "/openapi.json", PUBLIC),
    ("POST", "/docs", CHANGE_ALL),
    ("GET", "/docs/elsewhere", READ_ALL),
    ("GET", "/", PUBLIC),
    ("GET", "/leagues/board/verdicts", PUBLIC),
    ("HEAD", "/pages/app.js", PUBLIC),
    ("POST", "/leagues/board", CHANGE_ALL),
    ("GET", "/leaguesque", READ_ALL),
    ("GET", "/v1/leagues", READ_ALL),
    ("PUT", "/v1/leagues/board/versions/3/note", needs("promote", "board", is_change=True)),
    ("HEAD", "/v1/leagues/board", needs("read", "board")),
    ("POST", "/v1/leagues/board/aliases/champion", needs("promote", "board", is_change=True)),
    ("POST", "/v1/leagues/board/rollback", needs("promote", "board", is_change=True)),
    ("POST", "/v1/leagues/board/evaluations", needs("evaluate", "board", is_change=True)),
    ("DELETE", "/v1/leagues/board/evaluations/3", needs("evaluate", "board", is_change=True)),
    ("PUT", "/v1/leagues/board/evaluations/3", needs("promote", "board")),
    ("POST", "/v1/leagues/board/play", needs("act", "board")),
    ("PUT", "/v1/leagues/board/play", needs("promote", "board")),
    ("POST", "/v1/leagues/play", needs("promote", "play")),
    ("GET", "/v1/leagues/board/matches/s/3/games/0/video.gif", needs("read", "board")),
    ("GET", "/v1/leagues/board/evaluations/3/events", needs("read", "board", is_stream=True)),
    ("GET", "/v1/leagues/board/events", needs("read", "board", is_stream=True)),
    ("POST", "/v1/leagues/board/verdicts/won", needs("promote", "board")),
    ("POST", "/v1/leagues/evaluations", needs("promote", "evaluations")),
    ("GET", "/v1/health/ready", PUBLIC),
    ("GET", "/v2/health/live", PUBLIC),
    ("GET", "/v1/key", PUBLIC),
    ("POST", "/v1/key", CHANGE_ALL),
    ("POST", "/v2/health/live", CHANGE_ALL),
    ("GET", "/anything", READ_ALL),
    ("DELETE", "/v1/leagues/board", needs("promote", "board")),
    ("POST", "//v1/leagues/board/rollback", CHANGE_ALL),
    ("POST", "", CHANGE_ALL),
)


def test_permissions_of_requests(subtests: pytest.Subtests) -> None:
    for method, path, need in REQUESTS:
        with subtests.test(f"{method} {path}"):
            assert for_request("http", method, path) == need
    assert for_request("websocket", "GET", "/v1/policies/board/stream") == needs("act", "board")
    assert for_request("websocket", "GET", "/elsewhere") == needs("act", None, True)
    for rpc, model, need in (
        ("ServerLive", "", PUBLIC),
        ("ServerReady", "", PUBLIC),
        ("ServerMetadata", "", needs("read", None)),
        ("ModelReady", "board", needs("read", "board")),
        ("ModelInfer", "duo.left", needs("act", "duo")),
        ("ModelStatistics", "", READ_ALL),
        ("RepositoryIndex", "", READ_ALL),
    ):
        assert for_rpc(rpc, model) == need, rpc


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
    assert for_request("http", "GET", path) == needs("read", "x" * 300)
    assert for_rpc("ModelReady", model) == needs("read", model)
    assert [cached.cache_info().currsize for cached in (PERMISSIONS._cached, permissions._for_rpc)] == sizes


HOST = "127.0.0.1:8000"

SAME_SITE = [
    {},
    {"sec-fetch-site": "same-origin", "origin": f"http://{HOST}"},
    {"sec-fetch-site": "same-origin", "origin": "https://what.a.proxy.calls.itself"},
    {"sec-fetch-site": "none"},
    {"origin": f"http://{HOST}"},
    {"origin": f"https://{HOST}"},
]
CROSS_SITE = [
    {"sec-fetch-site": "cross-site", "origin": "https://evil.example"},
    {"sec-fetch-site": "cross-site"},
    {"sec-fetch-site": "same-site", "origin": "http://127.0.0.1:3000"},
    {"sec-fetch-site": "", "origin": f"http://{HOST}"},
    {"sec-fetch-site": "cross-site", "origin": f"http://{HOST}"},
    {"origin": "https://evil.example"},
    {"origin": "http://127.0.0.1:3000"},
    {"origin": f"http://{HOST}.evil.example"},
    {"origin": f"http://evil.example/{HOST}"},
    {"origin": "null"},
    {"origin": ""},
]


def encoded(headers: dict[str, str]) -> list[tuple[bytes, bytes]]:
    return [(name.encode(), value.encode()) for name, value in (headers | {"host": HOST}).items()]


def test_other_pages_can_only_read(subtests: pytest.Subtests) -> None:
    changes = [("http", method) for method in ("POST", "DELETE", "PUT", "OPTIONS")] + [("websocket", "GET")]
    for headers in SAME_SITE:
        with subtests.test("same site", headers=headers):
            for kind, method in changes:
                reject_cross_site(kind, method, encoded(headers))
    for headers in CROSS_SITE:
        with subtests.test("cross-site", headers=headers):
            for kind, method in changes:
                with pytest.raises(CrossSiteRequest):
                    reject_cross_site(kind, method, encoded(headers))
            for method in ("GET", "HEAD"):
                reject_cross_site("http", method, encoded(headers))


def test_each_route_rejects_cross_site_changes(read_only_client: TestClient) -> None:
    evil = {"origin": "https://evil.example"}
    for path in (ACTION, "/v1/leagues/board/rollback", "/v1/leagues/board/evaluations", "/docs"):
        reply = read_only_client.post(path, json=BODY, headers=evil)
        assert (reply.status_code, reply.json()["code"]) == (403, "cross_site")
        assert "https://evil.example" in reply.json()["message"]
    reply = read_only_client.post("/v2/models/board/infer", json={}, headers={"sec-fetch-site": "cross-site"})
    assert (reply.status_code, list(reply.json())) == (403, ["error"]), "the error format of this protocol"
    assert read_only_client.post(ACTION, json=BODY, headers={"origin": "http://localhost"}).status_code == 200
    assert read_only_client.get("/v1/leagues", headers=evil | {"sec-fetch-site": "cross-site"}).status_code == 200


GAME = "https://game.example"
LISTED = QUICK.model_copy(update={"cors_origins": [GAME]})
PREFLIGHT = {"access-control-request-method": "POST", "access-control-request-headers": "authorization,content-type"}


def allowed(reply: httpx.Response) -> str | None:
    return reply.headers.get("access-control-allow-origin")


def test_pages_of_listed_origins_call_with_a_key(registry: Registry) -> None:
    """On both paths: requests without an origin take the fast one."""
    _, secret = registry.keys.create("game", ["act"])
    with listening(registry.storage, LISTED) as listener, httpx.Client(base_url=listener.url) as client:
        for origin, status, answer in ((GAME, 200, GAME), ("https://game.example.evil", 400, None)):
            reply = client.options(ACTION, headers=PREFLIGHT | {"origin": origin})
            assert (reply.status_code, allowed(reply)) == (status, answer)
        key = {"authorization": f"Bearer {secret}"}
        from_page = {"origin": GAME, "sec-fetch-site": "cross-site"}
        reply = client.post(ACTION, json=BODY, headers=key | from_page)
        assert (reply.status_code, allowed(reply), reply.headers["access-control-expose-headers"]) == (200, GAME, "*")
        refused = client.post(ACTION, json=BODY, headers=from_page)
        assert (refused.status_code, allowed(refused)) == (401, GAME), "the page can read the error"
        elsewhere = client.post(ACTION, json=BODY, headers=key | from_page | {"origin": "https://evil.example"})
        assert (elsewhere.status_code, allowed(elsewhere)) == (403, None)
        assert client.post(ACTION, json=BODY, headers=key).json() == reply.json()


def test_a_stream_of_a_listed_origin_offers_its_key_as_a_subprotocol(registry: Registry) -> None:
    _, secret = registry.keys.create("game", ["act"])
    with listening(registry.storage, LISTED) as listener:
        open_stream = partial(connect, listener.stream("board"), origin=Origin(GAME), proxy=None)
        offered = [Subprotocol("policy-league"), Subprotocol(f"policy-league.key.{secret}")]
        with open_stream(subprotocols=offered) as stream:
            assert stream.subprotocol == "policy-league"
            stream.send(json.dumps(BODY))
            assert json.loads(stream.recv(60))["version"] == 1
        for subprotocols in (offered[:1], [offered[0], Subprotocol("policy-league.key.plk_wrong")]):
            with pytest.raises(InvalidStatus) as refused, open_stream(subprotocols=subprotocols):
                pass
            assert refused.value.response.status_code == 401


def test_only_names_of_the_loopback_interface_are_accepted() -> None:
    local = (
        "localhost",
        "LocalHost:8000",
        "league.localhost:8000",
        "127.0.0.1",
        "127.0.0.53:8000",
        "[::1]",
        "[::1]:8000",
    )
    rebound = ("rebound.example", "rebound.example:8000", "localhost.rebound.example", "127.0.0.1.rebound.example")
    addresses = ("10.0.0.1:8000", "0.0.0.0:8000", "[::2]:8000", "[::1")
    for host in local:
        reject_foreign_host([(b"accept", b"*/*"), (b"host", host.encode())])
    reject_foreign_host([(b"accept", b"*/*")])  # programs may send none
    for host in (*rebound, *addresses, "notlocalhost", "é", "", "localhost" * 1000):
        with pytest.raises(UntrustedHost, match="accepts only requests to localhost"):
            reject_foreign_host([(b"host", b"localhost"), (b"host", host.encode())])


REBOUND = {"host": "rebound.example:8000"}


def test_a_rebound_page_neither_reads_nor_acts(read_only_client: TestClient) -> None:
    for path in ("/v1/leagues", "/v1/leagues/board/versions", "/docs", "/metrics", "/v2/models/board"):
        assert read_only_client.get(path).status_code == 200
        response = read_only_client.get(path, headers=REBOUND)
        assert (response.status_code, "rebound.example:8000" in response.text) == (403, True)
    same_origin = REBOUND | {"sec-fetch-site": "same-origin", "origin": "http://rebound.example:8000"}
    response = read_only_client.post(ACTION, json=BODY, headers=same_origin)
    assert (response.status_code, response.json()["code"]) == (403, "untrusted_host")
    with (
        pytest.raises(WebSocketDenialResponse) as refused,
        read_only_client.websocket_connect("/v1/policies/board/stream", headers=REBOUND),
    ):
        pass
    assert refused.value.status_code == 403


def test_other_servers_have_any_name(storage: Storage, registry: Registry) -> None:
    registry.keys.create("reader", ["read"])
    for leagues, settings, is_exposed, status in (
        (storage, {"require_keys": "never"}, False, 200),
        (storage, {}, True, 401),
        (registry.storage, {}, False, 401),  # it has keys
    ):
        process = replace(this_process(), is_exposed=is_exposed)
        server = Replica(Registry.open(leagues), QUICK.model_copy(update=settings), "replica-1", process)
        with TestClient(server.application(), base_url="http://league.example") as client:
            assert client.get("/v1/leagues").status_code == status
