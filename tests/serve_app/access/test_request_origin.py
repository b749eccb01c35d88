"""Pages of other sites cannot change anything, even if no key is required; programs and our own pages can.

A server without keys on loopback answers only requests that name it so.
"""

import json
from dataclasses import replace

import httpx
import pytest
from starlette.testclient import TestClient, WebSocketDenialResponse
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Origin, Subprotocol

from league.registry.registry import Registry
from league.settings import Storage
from serve_app.access.errors import CrossSiteRequest, UntrustedHost
from serve_app.access.request_origin import reject_cross_site, reject_foreign_host
from serve_app.app import Replica
from serve_app.runtime.replica_process import this_process
from tests.support.clients.actions import BOARD
from tests.support.servers.replicas import QUICK
from tests.support.servers.streaming import listening

ACTION = "/v1/policies/board/action"
BODY = {"observation": BOARD}
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


@pytest.mark.parametrize("headers", SAME_SITE, ids=str)
def test_our_pages_and_programs_are_accepted(headers: dict[str, str]) -> None:
    for kind, method in (("http", "POST"), ("websocket", "GET")):
        reject_cross_site(kind, method, encoded(headers))


@pytest.mark.parametrize("headers", CROSS_SITE, ids=str)
def test_other_pages_can_only_read(headers: dict[str, str]) -> None:
    for kind, method in (*(("http", method) for method in ("POST", "DELETE", "PUT", "OPTIONS")), ("websocket", "GET")):
        with pytest.raises(CrossSiteRequest):
            reject_cross_site(kind, method, encoded(headers))
    for method in ("GET", "HEAD"):
        reject_cross_site("http", method, encoded(headers))


@pytest.mark.parametrize("path", [ACTION, "/v1/leagues/board/rollback", "/v1/leagues/board/evaluations", "/docs"])
def test_each_route_rejects_cross_site_changes(read_only_client: TestClient, path: str) -> None:
    reply = read_only_client.post(path, json=BODY, headers={"origin": "https://evil.example"})
    assert (reply.status_code, reply.json()["code"]) == (403, "cross_site")
    assert "https://evil.example" in reply.json()["message"]


def test_the_open_inference_protocol_has_its_own_error_format(read_only_client: TestClient) -> None:
    reply = read_only_client.post("/v2/models/board/infer", json={}, headers={"sec-fetch-site": "cross-site"})
    assert (reply.status_code, list(reply.json())) == (403, ["error"])


def test_our_page_can_act_and_another_can_read(read_only_client: TestClient) -> None:
    same_site, cross_site = (
        {"origin": "http://localhost"},
        {"origin": "https://evil.example", "sec-fetch-site": "cross-site"},
    )
    assert read_only_client.post(ACTION, json=BODY, headers=same_site).status_code == 200
    assert read_only_client.get("/v1/leagues", headers=cross_site).status_code == 200


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


@pytest.mark.parametrize("key", ["", "plk_wrong"])
def test_a_stream_of_a_listed_origin_offers_its_key_as_a_subprotocol(registry: Registry, key: str) -> None:
    _, secret = registry.keys.create("game", ["act"])
    with listening(registry.storage, LISTED) as listener:
        url = listener.stream("board")
        offered = [Subprotocol("policy-league"), Subprotocol(f"policy-league.key.{secret}")]
        with connect(url, origin=Origin(GAME), subprotocols=offered, proxy=None) as stream:
            assert stream.subprotocol == "policy-league"
            stream.send(json.dumps(BODY))
            assert json.loads(stream.recv(60))["version"] == 1
        others = offered[:1] + [Subprotocol(f"policy-league.key.{key}")] * bool(key)
        with (
            pytest.raises(InvalidStatus) as refused,
            connect(url, origin=Origin(GAME), subprotocols=others, proxy=None),
        ):
            pass
        assert refused.value.response.status_code == 401


@pytest.mark.parametrize(
    "host",
    ["localhost", "LocalHost:8000", "league.localhost:8000", "127.0.0.1", "127.0.0.53:8000", "[::1]", "[::1]:8000"],
)
def test_names_of_the_loopback_interface_are_accepted(host: str) -> None:
    reject_foreign_host([(b"accept", b"*/*"), (b"host", host.encode())])


@pytest.mark.parametrize(
    "host",
    [
        "rebound.example",
        "rebound.example:8000",
        "localhost.rebound.example",
        "127.0.0.1.rebound.example",
        "10.0.0.1:8000",
        "0.0.0.0:8000",
        "[::2]:8000",
        "[::1",
        "notlocalhost",
        "é",
        "",
        "localhost" * 1000,
    ],
)
def test_other_host_names_are_refused(host: str) -> None:
    with pytest.raises(UntrustedHost, match="accepts only requests to localhost"):
        reject_foreign_host([(b"host", b"localhost"), (b"host", host.encode())])


def test_programs_may_send_no_host() -> None:
    reject_foreign_host([(b"accept", b"*/*")])


REBOUND = {"host": "rebound.example:8000"}


@pytest.mark.parametrize("path", ["/v1/leagues", "/v1/leagues/board/versions", "/docs", "/metrics", "/v2/models/board"])
def test_a_rebound_page_reads_nothing(read_only_client: TestClient, path: str) -> None:
    assert read_only_client.get(path).status_code == 200
    response = read_only_client.get(path, headers=REBOUND)
    assert response.status_code == 403
    assert "rebound.example:8000" in response.text


def test_a_rebound_page_cannot_act(read_only_client: TestClient) -> None:
    same_origin = REBOUND | {"sec-fetch-site": "same-origin", "origin": "http://rebound.example:8000"}
    response = read_only_client.post(ACTION, json=BODY, headers=same_origin)
    assert (response.status_code, response.json()["code"]) == (403, "untrusted_host")
    with (
        pytest.raises(WebSocketDenialResponse) as refused,
        read_only_client.websocket_connect("/v1/policies/board/stream", headers=REBOUND),
    ):
        pass
    assert refused.value.status_code == 403


@pytest.mark.parametrize(("settings", "is_exposed"), [({"require_keys": "never"}, False), ({}, True)])
def test_other_servers_have_any_name(storage: Storage, settings: dict[str, str], is_exposed: bool) -> None:
    process = replace(this_process(), is_exposed=is_exposed)
    server = Replica(Registry.open(storage), QUICK.model_copy(update=settings), "replica-1", process)
    with TestClient(server.application(), base_url="http://league.example") as client:
        assert client.get("/v1/leagues").status_code == (401 if is_exposed else 200)


def test_a_server_with_keys_has_any_name(registry: Registry) -> None:
    _, token = registry.keys.create("reader", ["read"])
    server = Replica(Registry.open(registry.storage), QUICK, "replica-1")
    with TestClient(server.application(), base_url="http://league.example") as client:
        assert client.get("/v1/leagues", headers={"x-api-key": token}).status_code == 200
