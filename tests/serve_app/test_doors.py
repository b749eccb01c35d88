"""Who is let in, over every way that leads in, and what the others are told."""

import asyncio
import json
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from time import monotonic
from typing import Any

import httpx
import pytest
from starlette.testclient import TestClient, WebSocketDenialResponse

from league.errors import Overloaded
from league.registry.registry import Registry
from league.settings import Storage
from serve_app.app import Server
from serve_app.settings import ServeSettings
from tests.serve_app.conftest import QUICK
from tests.serve_app.leagues import everything
from tests.serve_app.test_action import BOARD

ACTION = "/v1/policies/board/action"
BODY = {"observation": BOARD}


def bearer(token: str) -> dict[str, str]:
    return {"authorization": f"Bearer {token}"}


@contextmanager
def served(registry: Registry, is_exposed: bool = False, **settings: Any) -> Iterator[TestClient]:
    """A replica's application, without Ray, with other settings than QUICK's."""
    server = Server(
        Registry.open(registry.storage),
        ServeSettings.model_validate(QUICK.model_dump() | settings),
        "replica-1",
        is_exposed=is_exposed,
    )
    with TestClient(server.application()) as client:
        yield client


def until(condition: Callable[[], object], seconds: float = 20) -> None:
    deadline = monotonic() + seconds
    while not condition():
        assert monotonic() < deadline


def refused(reply: httpx.Response, status: int, code: str, *words: str) -> None:
    assert (reply.status_code, reply.json().get("code")) == (status, code), reply.text
    for word in words:
        assert word in reply.json()["message"]


def test_without_a_key_in_the_registry_a_server_on_loopback_is_open(client: TestClient) -> None:
    assert client.post(ACTION, json=BODY).status_code == 200
    assert client.get("/v1/leagues").status_code == 200
    assert client.post(ACTION, json=BODY, headers=bearer("whatever")).status_code == 200


def test_the_first_key_locks_and_its_revocation_does_not_unlock(client: TestClient, registry: Registry) -> None:
    _, token = registry.create_key("bot", ["act"])
    until(lambda: client.post(ACTION, json=BODY).status_code == 401)
    reply = client.post(ACTION, json=BODY)
    refused(reply, 401, "unauthenticated", "Authorization: Bearer")
    assert reply.headers["www-authenticate"] == "Bearer"
    assert client.post(ACTION, json=BODY, headers=bearer(token)).status_code == 200
    registry.revoke_key("bot")
    until(lambda: client.post(ACTION, json=BODY, headers=bearer(token)).status_code == 401)
    refused(client.post(ACTION, json=BODY, headers=bearer(token)), 401, "unauthenticated", "revoked")
    assert client.post(ACTION, json=BODY).status_code == 401


def test_what_a_key_may_do_is_told_to_whoever_shows_it(client: TestClient, registry: Registry) -> None:
    assert client.get("/v1/key").json() == {"key": None, "is_needed": False}
    _, token = registry.create_key("night-owl", ["read", "evaluate"], only_leagues=["board"])
    told = {"name": "night-owl", "scopes": ["evaluate", "read"], "leagues": ["board"]}
    until(lambda: client.get("/v1/key").json() == {"key": None, "is_needed": True})
    assert client.get("/v1/key", headers=bearer(token)).json() == {"key": told, "is_needed": True}
    refused(client.get("/v1/key", headers=bearer("plk_none")), 401, "unauthenticated", "unknown")


def test_health_stays_open(registry: Registry) -> None:
    with served(registry, require_keys="always") as client:
        for path in ("/v1/health/live", "/v1/health/ready", "/v2/health/live", "/v2/health/ready"):
            assert client.get(path).status_code == 200
        refused(client.get("/v1/leagues"), 401, "unauthenticated", "league keys create NAME --scope read")


@pytest.mark.parametrize(
    ("require_keys", "is_exposed", "status"),
    [("auto", False, 200), ("auto", True, 401), ("always", False, 401), ("never", True, 200)],
)
def test_whether_keys_are_needed_before_there_is_one(
    registry: Registry, require_keys: str, is_exposed: bool, status: int
) -> None:
    with served(registry, is_exposed, require_keys=require_keys) as client:
        assert client.post(ACTION, json=BODY).status_code == status
        assert client.get("/v2/models/board").status_code == status


def test_never_is_never(registry: Registry) -> None:
    registry.create_key("bot", ["act"])
    with served(registry, require_keys="never") as client:
        assert client.post(ACTION, json=BODY).status_code == 200


@pytest.mark.parametrize("header", ["authorization", "x-api-key"])
def test_a_key_opens_what_its_scope_says(registry: Registry, header: str) -> None:
    tokens = {scope: registry.create_key(scope, [scope])[1] for scope in ("act", "read", "promote")}
    calls: dict[str, tuple[str, str]] = {
        "act": ("POST", ACTION),
        "read": ("GET", "/v1/leagues/board"),
        "promote": ("POST", "/v1/leagues/board/rollback"),
    }
    with served(registry) as client:
        for scope, token in tokens.items():
            shown = {header: f"bEARER {token}" if header == "authorization" else token}
            for needed, (method, path) in calls.items():
                reply = client.request(method, path, json=BODY if needed == "act" else {}, headers=shown)
                if scope != needed:
                    refused(reply, 403, "forbidden", f"scope {needed}", f"{scope} is for {scope}")
                else:
                    assert reply.status_code not in (401, 403), reply.text


def test_a_key_for_leagues_opens_only_those(registry: Registry) -> None:
    _, token = registry.create_key("bot", ["act", "read"], only_leagues=["board", "duo"])
    with served(registry) as client:
        client.headers.update(bearer(token))
        assert client.post(ACTION, json=BODY).status_code == 200
        assert client.post("/v1/policies/duo.left/action", json=BODY).status_code == 200
        assert client.get("/v2/models/duo.left").status_code == 200
        assert client.get("/v2").status_code == 200
        refused(client.post("/v1/policies/vector/action", json={"observation": [0, 0]}), 403, "forbidden", "duo")
        refused(client.get("/v1/leagues/vector"), 403, "forbidden", "another league")
        refused(client.get("/v1/leagues"), 403, "forbidden", "all leagues")
        assert client.get("/v2/models/vector").json() == {
            "error": "this is about another league: bot is for board, duo"
        }
        assert client.get("/v2/models/stats").status_code == 403


def test_a_key_expires_without_being_asked(registry: Registry) -> None:
    expires_at = datetime.now(UTC) + timedelta(seconds=2)
    _, token = registry.create_key("bot", ["act"], expires_at=expires_at)
    with served(registry) as client:
        seen = []
        until(lambda: seen.append(client.post(ACTION, json=BODY, headers=bearer(token)).status_code) or seen[-1] == 401)
        assert datetime.now(UTC) >= expires_at
        assert seen[0] == 200


def test_a_rate_is_kept(registry: Registry) -> None:
    tokens = [registry.create_key(name, ["act"], rate=rate)[1] for name, rate in (("slow", 0.5), ("fast", None))]
    with served(registry) as client:
        assert client.post(ACTION, json=BODY, headers=bearer(tokens[0])).status_code == 200
        reply = client.post(ACTION, json=BODY, headers=bearer(tokens[0]))
        refused(reply, 429, "rate_limited", "slow may call 0.5 times a second")
        assert reply.headers["retry-after"] == "2"
        for _ in range(20):
            assert client.post(ACTION, json=BODY, headers=bearer(tokens[1])).status_code == 200


def test_a_stream_without_a_key_is_told_why(registry: Registry) -> None:
    _, token = registry.create_key("bot", ["read"])
    with served(registry) as client:
        for headers, status in (({}, 401), (bearer(token), 403)):
            with (
                pytest.raises(WebSocketDenialResponse) as caught,
                client.websocket_connect("/v1/policies/board/stream", headers=headers),
            ):
                pass
            assert caught.value.status_code == status
            assert caught.value.json()["code"] in ("unauthenticated", "forbidden")


def test_keys_that_are_known_stay_while_the_database_is_gone(registry: Registry) -> None:
    _, token = registry.create_key("bot", ["act"])
    server = Server(Registry.open(registry.storage), QUICK, "replica-1")
    with TestClient(server.application()) as client:
        server.registry.database.close()
        registry.storage.home.rename(registry.storage.home.with_name("elsewhere"))
        assert client.post(ACTION, json=BODY, headers=bearer(token)).status_code == 200
        assert client.post(ACTION, json=BODY).status_code == 401
        registry.storage.home.with_name("elsewhere").rename(registry.storage.home)


def test_a_registry_that_has_lost_its_keys_opens_no_door(
    registry: Registry, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    registry.create_key("bot", ["act"])
    Registry.open(Storage.at(tmp_path / "other")).close()
    with served(registry) as client:
        registry.storage.home.rename(tmp_path / "away")
        (tmp_path / "other").rename(registry.storage.home)
        until(lambda: "has no API key any more" in caplog.text)
        assert client.post(ACTION, json=BODY).status_code == 401


def test_a_standing_queue_is_cut(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    server = Server(Registry.open(registry.storage), QUICK, "replica-1")

    def full() -> None:
        raise Overloaded("more than 64 requests wait here already")

    with TestClient(server.application()) as client:
        monkeypatch.setattr(type(server.doors.backlog), "admit", lambda _: full())
        for path in (ACTION, "/v2/models/board/infer"):
            reply = client.post(path, json=BODY)
            assert (reply.status_code, reply.headers["retry-after"]) == (429, "1")
        assert client.get("/v1/leagues").status_code == 200, "those who look are few"


@pytest.mark.parametrize("value", ["", "0", "-5", "1.5", "soon", "9" * 30, "٣"])
def test_a_time_limit_that_is_none(unchanging: TestClient, value: str) -> None:
    headers = [(b"x-request-timeout-ms", value.encode())]
    refused(unchanging.post(ACTION, json=BODY, headers=headers), 400, "invalid_input", "x-request-timeout-ms")  # type: ignore[arg-type]


def test_a_time_limit_that_is_kept_changes_nothing(unchanging: TestClient) -> None:
    assert unchanging.post(ACTION, json=BODY, headers={"x-request-timeout-ms": "4000"}).status_code == 200


@pytest.mark.anyio
async def test_a_reply_that_nobody_reads_is_not_begun_twice(tmp_path: Path) -> None:
    registry = everything(Storage.at(tmp_path / "home"))
    server = Server(registry, ServeSettings.model_validate(QUICK.model_dump() | {"timeout": 0.05}), "replica-1")
    application = server.application()
    said: list[str] = []

    async def receive() -> dict[str, Any]:
        return {"type": "http.request", "body": json.dumps(BODY).encode(), "more_body": False}

    async def send(message: Any) -> None:
        said.append(message["type"])
        if message["type"] == "http.response.body":
            await asyncio.Event().wait()

    scope = {"type": "http", "method": "POST", "path": ACTION, "query_string": b"", "headers": []}
    async with application.router.lifespan_context(application):
        await application(scope, receive, send)
    assert said == ["http.response.start", "http.response.body"]
    assert server.action.in_flight == 0


@pytest.mark.anyio
@pytest.mark.parametrize("path", [ACTION, "/v2/models/board/infer"])
async def test_a_body_that_does_not_come_is_not_waited_for(tmp_path: Path, path: str) -> None:
    registry = everything(Storage.at(tmp_path / "home"))
    server = Server(registry, ServeSettings.model_validate(QUICK.model_dump() | {"timeout": 0.05}), "replica-1")
    application = server.application()

    async def drip() -> AsyncIterator[bytes]:
        yield b'{"observation": '
        await asyncio.Event().wait()

    async with application.router.lifespan_context(application):
        transport = httpx.ASGITransport(app=application)
        async with httpx.AsyncClient(transport=transport, base_url="http://replica") as client:
            reply = await client.post(path, content=drip())
            assert (reply.status_code, reply.headers["connection"]) == (408, "close")
            assert (await client.post(ACTION, json=BODY)).status_code == 200
    assert server.action.in_flight == 0


@pytest.mark.anyio
async def test_a_reply_that_takes_too_long_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    registry = everything(Storage.at(tmp_path / "home"))
    server = Server(registry, QUICK, "replica-1")
    application = server.application()

    async def forever(*_: Any) -> None:
        await asyncio.Event().wait()

    async with application.router.lifespan_context(application):
        monkeypatch.setattr(server.models, "find", forever)
        transport = httpx.ASGITransport(app=application)
        async with httpx.AsyncClient(transport=transport, base_url="http://replica") as client:
            reply = await client.post(ACTION, json=BODY, headers={"x-request-timeout-ms": "50"})
            refused(reply, 504, "deadline_exceeded", "0.05 s")
