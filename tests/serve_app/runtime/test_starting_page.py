"""A server that starts responds with 503 on both ports, until Ray's HAProxy takes over."""

from collections.abc import Iterator
from pathlib import Path

import grpc
import httpx
import pytest

from serve_app.runtime import haproxy, haproxy_script
from serve_app.runtime.starting_page import starting_page
from tests.support.waiting import until


@pytest.fixture
def ports(tmp_path: Path) -> Iterator[tuple[int, int]]:
    http, rpc = haproxy.free_ports(2, "127.0.0.1")
    binary = haproxy_script.find_haproxy()
    assert binary is not None
    with starting_page(tmp_path, binary, "127.0.0.1", http, rpc):
        until(lambda: not haproxy.is_free("127.0.0.1", http))
        yield http, rpc


def test_http_requests_are_answered_with_503_and_a_page_or_a_document(ports: tuple[int, int]) -> None:
    with httpx.Client(base_url=f"http://127.0.0.1:{ports[0]}", trust_env=False) as client:
        for path, accept in (("/", "*/*"), ("/leagues/board", "text/html,application/xml;q=0.9")):
            page = client.get(path, headers={"accept": accept})
            assert (page.status_code, page.headers["content-type"]) == (503, "text/html")
            assert "The server is starting" in page.text
        message = "the server is starting: repeat the request"
        for path, expected in (
            ("/v1/health/ready", {"code": "not_ready", "message": message}),
            ("/v2/health/ready", {"error": message}),
        ):
            response = client.get(path)
            assert (response.status_code, response.headers["retry-after"]) == (503, "1")
            assert response.json() == expected
        assert client.post("/v1/policies/board/action", json={}).status_code == 503


def test_grpc_calls_are_answered_with_unavailable(ports: tuple[int, int]) -> None:
    with grpc.insecure_channel(f"127.0.0.1:{ports[1]}") as channel, pytest.raises(grpc.RpcError) as caught:
        channel.unary_unary("/inference.GRPCInferenceService/ServerReady")(b"", timeout=20)
    assert caught.value.code() == grpc.StatusCode.UNAVAILABLE
    assert "starting" in caught.value.details()


def test_the_ports_are_free_afterwards(tmp_path: Path) -> None:
    (port,) = haproxy.free_ports(1, "127.0.0.1")
    binary = haproxy_script.find_haproxy()
    assert binary is not None
    with starting_page(tmp_path, binary, "127.0.0.1", port, None):
        until(lambda: not haproxy.is_free("127.0.0.1", port))
    assert haproxy.is_free("127.0.0.1", port)
