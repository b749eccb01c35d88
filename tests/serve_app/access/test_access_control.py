"""Authentication and authorization of requests in all protocols, and their error messages."""

import asyncio
import json
from collections.abc import AsyncIterator, Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from typing import Any

import httpx
import pytest
from starlette.testclient import TestClient, WebSocketDenialResponse
from starlette.types import Message

from league.errors import Overloaded
from league.registry.registry import Registry
from league.settings import Storage
from serve_app.access import api_keys
from serve_app.access.api_keys import TokenBucket
from serve_app.access.load_shedding import Backlog
from serve_app.app import Replica
from serve_app.codecs.request_limits import LARGE_BODY
from serve_app.runtime.haproxy_script import KEY_ACCEPTED
from serve_app.runtime.replica_process import this_process
from serve_app.settings import ServeSettings
from tests.support.clients.actions import BOARD
from tests.support.leagues.served_leagues import everything
from tests.support.servers.replicas import LOCALHOST, QUICK, local_client
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


def test_without_keys_a_server_on_loopback_is_open(client: TestClient) -> None:
    assert client.post(ACTION, json=BODY).status_code == 200
    assert client.get("/v1/leagues").status_code == 200
    assert client.post(ACTION, json=BODY, headers=bearer("whatever")).status_code == 200


def test_the_first_key_locks_the_server_and_its_revocation_does_not_unlock_it(
    client: TestClient, registry: Registry
) -> None:
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


@pytest.mark.parametrize("path", ["/", "/docs", "/openapi.json", "/v1/leagues", "/v1/nothing", "/v2", "/metrics", "/?"])
def test_browsers_do_not_guess_the_type_of_a_response(read_only_client: TestClient, path: str) -> None:
    for method in ("GET", "POST", "HEAD"):
        response = read_only_client.request(method, path)
        assert response.headers.get_list("x-content-type-options") == ["nosniff"], (method, response.status_code)


def test_an_error_of_ours_has_the_headers_of_a_response(storage: Storage, monkeypatch: pytest.MonkeyPatch) -> None:
    server = Replica(Registry.open(storage), QUICK, "replica-1")
    monkeypatch.setattr(server.models, "in_registry_thread", None)
    application = server.application()
    with TestClient(application, base_url=LOCALHOST, raise_server_exceptions=False) as client:
        response = client.get("/v1/leagues")
    assert (response.status_code, response.headers["x-content-type-options"]) == (500, "nosniff")


def test_health_routes_need_no_key(registry: Registry) -> None:
    with serving_replica(registry, require_keys="always") as client:
        for path in ("/v1/health/live", "/v1/health/ready", "/v2/health/live", "/v2/health/ready"):
            assert client.get(path).status_code == 200
        assert_rejected(client.get("/v1/leagues"), 401, "unauthenticated", "league keys create NAME --scope read")


@pytest.mark.parametrize(
    ("require_keys", "is_exposed", "status"),
    [("auto", False, 200), ("auto", True, 401), ("always", False, 401), ("never", True, 200)],
)
def test_whether_keys_are_required_before_one_exists(
    registry: Registry, require_keys: str, is_exposed: bool, status: int
) -> None:
    with serving_replica(registry, is_exposed, require_keys=require_keys) as client:
        assert client.post(ACTION, json=BODY).status_code == status
        assert client.get("/v2/models/board").status_code == status


def test_keys_are_never_required_with_never(registry: Registry) -> None:
    registry.keys.create("bot", ["act"])
    with serving_replica(registry, require_keys="never") as client:
        assert client.post(ACTION, json=BODY).status_code == 200


@pytest.mark.parametrize("header", ["authorization", "x-api-key"])
def test_a_key_is_limited_to_its_scope(registry: Registry, header: str) -> None:
    tokens = {scope: registry.keys.create(scope, [scope])[1] for scope in ("act", "read", "promote")}
    calls: dict[str, tuple[str, str]] = {
        "act": ("POST", ACTION),
        "read": ("GET", "/v1/leagues/board"),
        "promote": ("POST", "/v1/leagues/board/rollback"),
    }
    with serving_replica(registry) as client:
        for scope, token in tokens.items():
            shown = {header: f"bEARER {token}" if header == "authorization" else token}
            for needed, (method, path) in calls.items():
                reply = client.request(method, path, json=BODY if needed == "act" else {}, headers=shown)
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


@pytest.mark.usefixtures("_stopped_clock")
def test_a_rate_limit_is_enforced(registry: Registry) -> None:
    tokens = [registry.keys.create(name, ["act"], rate=rate)[1] for name, rate in (("slow", 0.5), ("fast", None))]
    with serving_replica(registry) as client:
        assert client.post(ACTION, json=BODY, headers=bearer(tokens[0])).status_code == 200
        reply = client.post(ACTION, json=BODY, headers=bearer(tokens[0]))
        assert_rejected(reply, 429, "rate_limited", "rate limit exceeded: the key slow allows 0.5 requests per second")
        assert reply.headers["retry-after"] == "2"
        for _ in range(20):
            assert client.post(ACTION, json=BODY, headers=bearer(tokens[1])).status_code == 200


@pytest.fixture
def _stopped_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    """Keys get no tokens back, however long a test takes."""
    monkeypatch.setattr(api_keys, "TokenBucket", partial(TokenBucket, clock=lambda: 0.0))


@pytest.mark.usefixtures("_stopped_clock")
def test_a_large_body_counts_as_several_requests(registry: Registry) -> None:
    _, token = registry.keys.create("slow", ["act"], rate=0.5)
    with serving_replica(registry) as client:
        large = json.dumps(BODY).encode() + b" " * LARGE_BODY
        assert client.post(ACTION, content=large, headers=bearer(token)).status_code == 413
        reply = client.post(ACTION, json=BODY, headers=bearer(token))
        assert_rejected(reply, 429, "rate_limited", "the key slow allows 0.5 requests per second")
        assert reply.headers["retry-after"] == "4"


@pytest.mark.parametrize(("is_late", "admissions"), [(False, 1), (True, 2)])
def test_a_body_that_arrives_late_is_admitted_like_a_request(
    registry: Registry, monkeypatch: pytest.MonkeyPatch, is_late: bool, admissions: int
) -> None:
    """Otherwise clients could open many requests, and send all bodies at the same time."""
    server, sent = Replica(Registry.open(registry.storage), QUICK, "replica-1"), []
    admitted: list[None] = []
    admit = Backlog.admit
    monkeypatch.setattr(Backlog, "admit", lambda backlog: admitted.append(admit(backlog)))

    async def receive() -> Message:
        for _ in range(3 * is_late):
            await asyncio.sleep(0)
        return {"type": "http.request", "body": json.dumps(BODY).encode()}

    async def send(message: Message) -> None:
        sent.append(message)

    scope = {"type": "http", "method": "POST", "headers": [], "query_string": b"", "path_params": {"model": "board"}}

    async def call() -> None:
        server.access.backlog.admit()  # as the middleware does
        await server.action(scope, receive, send)

    with local_client(server) as client:
        assert client.portal is not None
        client.portal.call(call)
    assert (sent[0]["status"], len(admitted)) == (200, admissions)


def test_a_rejected_stream_has_an_error_response(registry: Registry) -> None:
    _, token = registry.keys.create("bot", ["read"])
    with serving_replica(registry) as client:
        for headers, status in (({}, 401), (bearer(token), 403)):
            with (
                pytest.raises(WebSocketDenialResponse) as caught,
                client.websocket_connect("/v1/policies/board/stream", headers=headers),
            ):
                pass
            assert caught.value.status_code == status
            assert caught.value.json()["code"] in ("unauthenticated", "forbidden")


def test_known_keys_are_valid_while_the_database_is_unreachable(registry: Registry) -> None:
    _, token = registry.keys.create("bot", ["act"])
    server = Replica(Registry.open(registry.storage), QUICK, "replica-1")
    with local_client(server) as client:
        server.registry.database.close()
        registry.storage.home.rename(registry.storage.home.with_name("elsewhere"))
        assert client.post(ACTION, json=BODY, headers=bearer(token)).status_code == 200
        assert client.post(ACTION, json=BODY).status_code == 401
        registry.storage.home.with_name("elsewhere").rename(registry.storage.home)


def test_a_registry_without_its_keys_does_not_unlock_the_server(
    registry: Registry, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    registry.keys.create("bot", ["act"])
    Registry.open(Storage.at(tmp_path / "other")).close()
    with serving_replica(registry) as client:
        registry.storage.home.rename(tmp_path / "away")
        (tmp_path / "other").rename(registry.storage.home)
        until(lambda: "it is a different database" in caplog.text)
        assert client.post(ACTION, json=BODY).status_code == 401


def test_a_persistent_queue_is_shed(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    server = Replica(Registry.open(registry.storage), QUICK, "replica-1")

    def full() -> None:
        raise Overloaded("more than 64 requests wait here already")

    with local_client(server) as client:
        monkeypatch.setattr(type(server.access.backlog), "admit", lambda _: full())
        for path in (ACTION, "/v2/models/board/infer"):
            reply = client.post(path, json=BODY)
            assert (reply.status_code, reply.headers["retry-after"]) == (429, "1")
        assert client.get("/v1/leagues").status_code == 200, "only actions are shed"


@pytest.mark.parametrize("value", ["", "0", "-5", "1.5", "soon", "9" * 30, "٣"])
def test_an_invalid_time_limit_is_rejected(read_only_client: TestClient, value: str) -> None:
    headers = [(b"x-request-timeout-ms", value.encode())]
    assert_rejected(
        read_only_client.post(ACTION, json=BODY, headers=headers), 400, "invalid_input", "x-request-timeout-ms"
    )  # type: ignore[arg-type]


def test_a_sufficient_time_limit_changes_nothing(read_only_client: TestClient) -> None:
    assert read_only_client.post(ACTION, json=BODY, headers={"x-request-timeout-ms": "4000"}).status_code == 200


# Their inference runs on the event loop, so that it is not interrupted by the timeout.
IMPATIENT = ServeSettings.model_validate(QUICK.model_dump() | {"timeout": 0.05, "inline": 10.0})


@pytest.mark.anyio
async def test_a_response_that_is_not_read_is_not_started_twice(tmp_path: Path) -> None:
    registry = everything(Storage.at(tmp_path / "home"))
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
    assert server.action.in_flight == 0


@pytest.mark.anyio
@pytest.mark.parametrize("path", [ACTION, "/v2/models/board/infer"])
async def test_a_body_that_does_not_arrive_times_out(tmp_path: Path, path: str) -> None:
    registry = everything(Storage.at(tmp_path / "home"))
    server = Replica(registry, IMPATIENT, "replica-1")
    application = server.application()

    async def slow_body() -> AsyncIterator[bytes]:
        yield b'{"observation": '
        await asyncio.Event().wait()

    async with application.router.lifespan_context(application):
        transport = httpx.ASGITransport(app=application)
        async with httpx.AsyncClient(transport=transport, base_url=LOCALHOST) as client:
            reply = await client.post(path, content=slow_body())
            assert (reply.status_code, reply.headers["connection"]) == (408, "close")
            assert (await client.post(ACTION, json=BODY)).status_code == 200
    assert server.action.in_flight == 0


@pytest.mark.anyio
@pytest.mark.parametrize(("limit", "requested"), [(4.5, "50"), (0.05, "60000")], ids=["requested", "of the server"])
async def test_a_slow_response_times_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: float, requested: str
) -> None:
    """A client can only shorten the timeout of the server."""
    registry = everything(Storage.at(tmp_path / "home"))
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
