"""A node of a cluster starts HAProxy by `league-haproxy`, with the same limits as `league serve`."""

import os
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import httpx
import pytest
from starlette.types import Receive, Scope, Send

from serve_app.runtime import haproxy, haproxy_script
from tests.support.servers.http_protocol import serving
from tests.support.waiting import until

COMMAND = str(Path(sys.executable).with_name(haproxy_script.COMMAND))
NODE = os.environ | {haproxy_script.BINARY_PATH: COMMAND}
"""The environment of a node, in which Ray's HAProxy is the command itself."""
CONFIGURATION = """global
    maxconn 16384
defaults
    mode http
    timeout client 60s
    timeout connect 5s
    timeout server 5s
frontend prometheus
    bind :{metrics}
frontend http_frontend
    bind 127.0.0.1:1
listen stats
    bind *:{stats}
"""


def check(configuration: Path, **environment: str) -> "subprocess.CompletedProcess[str]":
    """Let HAProxy check a configuration: `-c` starts nothing."""
    command = [COMMAND, "-db", "-f", str(configuration), "-c"]
    return subprocess.run(command, env=NODE | environment, capture_output=True, text=True, timeout=60)


@pytest.mark.parametrize(
    ("environment", "stats", "metrics"),
    [
        ({}, 8404, 9101),
        ({"RAY_SERVE_HAPROXY_STATS_PORT": "8500", "RAY_SERVE_HAPROXY_METRICS_PORT": "8501"}, 8500, 8501),
    ],
    ids=["ports of Ray", "other ports"],
)
def test_a_node_has_the_limits(environment: dict[str, str], stats: int, metrics: int, tmp_path: Path) -> None:
    configuration = tmp_path / "haproxy.cfg"
    configuration.write_text(CONFIGURATION.format(stats=stats, metrics=metrics))
    checked = check(configuration, **environment)
    assert checked.returncode == 0, checked.stderr
    amended = configuration.read_text()
    assert "timeout tunnel 3600s" in amended, "idle WebSockets would end with the timeout of a request"
    assert "timeout http-request 10s" in amended
    assert "option http-buffer-request" in amended
    assert "timeout check 5s" in amended, "a busy replica has more time than the interval of health checks"
    assert f"bind 127.0.0.1:{stats}" in amended, "statistics are for this machine only"
    assert f"bind 127.0.0.1:{metrics}" in amended


@pytest.mark.parametrize(("descriptors", "connections"), [(1_000, 320), (20_000, 7_920), (50_000, 16_384)])
def test_a_node_accepts_the_connections_for_which_it_has_descriptors(
    descriptors: int, connections: int, tmp_path: Path
) -> None:
    configuration = tmp_path / "haproxy.cfg"
    configuration.write_text(CONFIGURATION.format(stats=8404, metrics=9101))
    (tmp_path / "binary").write_text("#!/bin/sh\n")
    (tmp_path / "binary").chmod(0o700)
    wrapper = haproxy_script.install(tmp_path, str(tmp_path / "binary"), 8404, 9101)
    # A limit can only be lowered: the shell reports the one of the test.
    shell = f"ulimit() {{ echo {descriptors}; }}\n"
    wrapper.write_text(wrapper.read_text().replace("\n", f"\n{shell}", 1))
    subprocess.run([str(wrapper), "-f", str(configuration)], check=True, timeout=60)
    assert f"    maxconn {connections}\n" in configuration.read_text()


def test_options_without_a_configuration_are_passed_on() -> None:
    shown = subprocess.run([COMMAND, "-v"], env=NODE, capture_output=True, text=True, timeout=60)
    assert shown.returncode == 0
    assert shown.stdout.startswith("HAProxy version")


BACKEND = """backend http-league
    default-server inter 1h
{http}    server SERVE_PROXY_ACTOR-head 127.0.0.1:7 check backup
backend grpc-league
{grpc}    server SERVE_PROXY_ACTOR-head 127.0.0.1:8 proto h2 check backup
backend other
    server one 127.0.0.1:6 check
"""
"""As Ray writes it, with the head's own proxy."""
REPLICAS = """    server one 127.0.0.1:4 {protocol}check observe layer4
    server two 127.0.0.1:5 {protocol}check observe layer4
"""


def processes_of(directory: Path) -> str:
    found = subprocess.run(["pgrep", "-f", f"{directory}/"], capture_output=True, text=True, timeout=60)
    return found.stdout


def test_the_last_known_replicas_are_kept_while_the_controller_finds_them_again(tmp_path: Path) -> None:
    """A restarted controller that needs more than ten seconds for that announces an application without replicas."""
    (tmp_path / "binary").write_text("#!/bin/sh\n")
    (tmp_path / "binary").chmod(0o700)
    wrapper = haproxy_script.install(tmp_path, str(tmp_path / "binary"), 8404, 9101)
    configuration = tmp_path / "haproxy.cfg"

    def servers_after(servers: str) -> list[str]:
        backends = BACKEND.format(http=servers.format(protocol=""), grpc=servers.format(protocol="proto h2 "))
        configuration.write_text(f"frontend http_frontend\n    use_backend http-league if TRUE\n{backends}")
        subprocess.run([str(wrapper), "-f", str(configuration)], check=True, timeout=60)
        http, grpc, other = (
            [line.split()[1] for line in backend.splitlines() if line.strip().startswith("server ")]
            for backend in configuration.read_text().split("backend ")[2:]
        )
        assert (http, other) == (grpc, ["one"])
        return http

    head = "SERVE_PROXY_ACTOR-head"
    assert servers_after(REPLICAS) == ["one", "two", head]
    assert sorted(servers_after("")) == [head, "one", "two"]
    assert sorted(servers_after("")) == [head, "one", "two"], "however often it is announced"
    assert servers_after(REPLICAS.replace("two", "three")) == ["one", "three", head], "one is replaced"
    assert sorted(servers_after("")) == [head, "one", "three"]
    until(lambda: not processes_of(tmp_path))  # no stand-in waits for the end of an HAProxy that has ended


PROXY = """defaults
    mode http
    timeout connect 1s
    timeout client 10s
    timeout server 500ms
    errorfile 502 {directory}/500.http
    errorfile 503 {directory}/500.http
    errorfile 504 {directory}/500.http
frontend http_frontend
    bind 127.0.0.1:{port}
    use_backend replicas if TRUE
backend replicas
    server one 127.0.0.1:{replica} check inter 1h
"""
"""As Ray writes it: its own page for all errors."""


@contextmanager
def proxy(directory: Path, replica: int) -> Iterator[str]:
    """HAProxy in front of a replica's port, started as Ray starts it. Yields its URL."""
    (port,) = haproxy.free_ports(1, "127.0.0.1")
    configuration = directory / "haproxy.cfg"
    configuration.write_text(PROXY.format(directory=directory, port=port, replica=replica))
    with subprocess.Popen([COMMAND, "-db", "-f", str(configuration)], env=NODE, stderr=subprocess.DEVNULL) as process:
        try:
            until(lambda: not haproxy.is_free("127.0.0.1", port))
            yield f"http://127.0.0.1:{port}"
        finally:
            (directory / haproxy_script.STOPPED).touch()  # no stand-in
            process.kill()


def refused(directory: Path, path: str, replica: int) -> dict[str, str]:
    """HAProxy's own response to a request, which is an error."""
    with proxy(directory, replica) as url, httpx.Client(base_url=url, trust_env=False) as client:
        response = client.post(path, json={})
    assert (response.headers["content-type"], response.headers["retry-after"]) == ("application/json", "1")
    document: dict[str, str] = response.json()
    assert document["error"] == document["message"], "the field of /v2 is that of /v1"
    return {"status": str(response.status_code), "code": document["code"]}


@pytest.mark.parametrize("path", ["/v1/policies/board/action", "/v2/models/board/infer"])
def test_errors_of_haproxy_are_those_of_the_api(path: str, tmp_path: Path) -> None:
    with socket.socket() as replica:
        replica.bind(("127.0.0.1", 0))
        port = replica.getsockname()[1]
        assert refused(tmp_path, path, port) == {"status": "503", "code": "no_replica"}, "nobody listens"
        replica.listen()
        assert refused(tmp_path, path, port) == {"status": "504", "code": "deadline_exceeded"}, "it does not respond"


def test_a_replica_that_ends_before_it_responds_is_reported(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as replica:

        def begin_a_response() -> None:
            with suppress(OSError):  # closed by the test
                while True:
                    connection, _ = replica.accept()
                    with connection:
                        if connection.recv(10_000):  # nothing from a health check
                            connection.sendall(b"HTTP/1.1 200")

        threading.Thread(target=begin_a_response, daemon=True).start()
        found = refused(tmp_path, "/v1/leagues", replica.getsockname()[1])
        replica.shutdown(socket.SHUT_RDWR)
    assert found == {"status": "502", "code": "replica_lost"}


CONNECTIONS = 40
"""`maxconn` of HAProxy, which is lower than for what descriptors suffice."""


@contextmanager
def crowded_proxy(directory: Path) -> Iterator[tuple[str, int]]:
    """The address of an HAProxy for few connections. Its replica accepts the key of requests for /key."""

    async def answer(scope: Scope, receive: Receive, send: Send) -> None:
        headers = [(b"content-length", b"0")]
        if scope["path"] == "/key":
            headers.append((haproxy_script.KEY_ACCEPTED.encode(), b"1"))
        await send({"type": "http.response.start", "status": 200, "headers": headers})
        await send({"type": "http.response.body"})

    (port,) = haproxy.free_ports(1, "127.0.0.1")
    with serving(answer, "uvloop") as replica:
        text = f"global\n    maxconn {CONNECTIONS}\n"
        text += PROXY.format(directory=directory, port=port, replica=replica[1])
        (directory / "haproxy.cfg").write_text(text)
        command = [COMMAND, "-db", "-f", str(directory / "haproxy.cfg")]
        with subprocess.Popen(command, env=NODE, stderr=subprocess.DEVNULL) as process:
            try:
                until(lambda: not haproxy.is_free("127.0.0.1", port))
                yield "127.0.0.1", port
            finally:
                (directory / haproxy_script.STOPPED).touch()
                process.kill()


def head_of_response(client: socket.socket, path: str) -> bytes:
    client.settimeout(20)
    client.sendall(f"GET {path} HTTP/1.1\r\nhost: here\r\n\r\n".encode())
    return client.recv(4096)


def test_idle_connections_do_not_shut_out_others(tmp_path: Path) -> None:
    """While many are open, each is closed after its response, unless a replica has accepted its key."""
    with crowded_proxy(tmp_path) as address, ExitStack() as until_closed:

        def connect() -> socket.socket:
            return until_closed.enter_context(socket.create_connection(address))

        with_key = [connect() for _ in range(3)]
        for client in with_key:
            reply = head_of_response(client, "/key")
            assert haproxy_script.KEY_ACCEPTED.encode() not in reply
            assert b"x-content-type-options: nosniff" in reply
        closed = 0
        for _ in range(2 * CONNECTIONS):
            reply = head_of_response(connect(), "/")
            assert reply.startswith(b"HTTP/1.1 200 ")
            closed += b"connection: close" in reply
        assert closed == 2 * CONNECTIONS + len(with_key) - CONNECTIONS // 4
        for client in with_key:
            assert b"connection: close" not in head_of_response(client, "/")


def test_an_address_has_a_share_of_the_connections(tmp_path: Path) -> None:
    """A client of which nothing arrives does not shut out another one. All addresses 127.… are loopback."""
    with crowded_proxy(tmp_path) as address, ExitStack() as until_closed:
        for _ in range(2 * CONNECTIONS):
            with suppress(ConnectionResetError):  # one too many
                until_closed.enter_context(socket.create_connection(address, source_address=("127.0.0.2", 0)))
        with socket.create_connection(address) as client:
            assert head_of_response(client, "/").startswith(b"HTTP/1.1 200 ")
