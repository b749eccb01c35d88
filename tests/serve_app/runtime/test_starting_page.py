"""A server that starts responds with 503 on both ports, until Ray's HAProxy takes over."""

import socket
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import grpc
import httpx
import psutil
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


def test_the_process_that_was_replaced_is_reaped(tmp_path: Path) -> None:
    (port,) = haproxy.free_ports(1, "127.0.0.1")
    binary = haproxy_script.find_haproxy()
    assert binary is not None
    with starting_page(tmp_path, binary, "127.0.0.1", port, None):
        process = psutil.Process(int((tmp_path / haproxy_script.STAND_IN).read_text()))
        process.kill()
        until(lambda: not process.is_running())


CONFIGURATION = """global
    stats socket {directory}/admin.sock level admin expose-fd listeners
defaults
    mode http
    timeout connect 1s
    timeout client 10s
    timeout server 10s
frontend prometheus
    bind 127.0.0.1:{metrics}
    http-request return status 200
frontend http_frontend
    bind 127.0.0.1:{http}
{routes}listen stats
    bind *:{stats}
    http-request return status 200
"""
ROUTES = """    use_backend replicas if TRUE
backend replicas
    server one 127.0.0.1:{replica} check
"""


def test_haproxy_listens_on_all_ports_after_it_has_taken_over(tmp_path: Path) -> None:
    """Ray's first HAProxy has no replica and no port of the server; the next one replaces it and the page."""
    http, metrics, stats = haproxy.free_ports(3, "127.0.0.1")
    binary = haproxy_script.find_haproxy()
    assert binary is not None
    wrapper = haproxy_script.install(tmp_path, binary, stats, metrics)
    configuration = tmp_path / "haproxy.cfg"

    def start(routes: str, *arguments: str) -> "subprocess.Popen[bytes]":
        configuration.write_text(
            CONFIGURATION.format(directory=tmp_path, http=http, metrics=metrics, stats=stats, routes=routes)
        )
        command = [str(wrapper), "-db", "-f", str(configuration), "-dR", *arguments]
        process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
        processes.callback(process.wait)
        processes.callback(process.kill)
        return process

    with ExitStack() as processes:
        replica = processes.enter_context(socket.create_server(("127.0.0.1", 0)))
        processes.enter_context(starting_page(tmp_path, binary, "127.0.0.1", http, None))
        processes.callback((tmp_path / haproxy_script.STOPPED).touch)
        first = start("")
        until(lambda: not haproxy.is_free("127.0.0.1", metrics) and not haproxy.is_free("127.0.0.1", http))
        start(
            ROUTES.format(replica=replica.getsockname()[1]), "-sf", str(first.pid), "-x", str(tmp_path / "admin.sock")
        )
        until(lambda: first.poll() is not None)
        for port in (http, metrics, stats):
            until(lambda port=port: not haproxy.is_free("127.0.0.1", port))
            with socket.create_connection(("127.0.0.1", port), timeout=5):
                pass
