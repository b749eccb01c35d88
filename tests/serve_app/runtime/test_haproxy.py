"""Each server has its own HAProxy: its files, ports and limits, and its end."""

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

from league.errors import ConfigError, NotReady
from serve_app.runtime import haproxy, haproxy_script
from tests.support.ipv6 import needs_ipv6
from tests.support.servers.http_protocol import serving
from tests.support.waiting import until

NODE = "n" * 56
"""The directory that Ray inserts between HAProxy's directory and its socket."""


BINARY = str(haproxy_script.find_haproxy())


@pytest.fixture
def directories(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(haproxy, "DIRECTORIES", tmp_path)
    return tmp_path


def test_the_directory_exists_while_the_context_lasts(directories: Path) -> None:
    with haproxy.private_directory() as directory:
        assert directory.stat().st_mode & 0o077 == 0, "the directory is private"
    assert list(directories.iterdir()) == []


def test_the_path_of_the_socket_is_short_enough_for_haproxy() -> None:
    with haproxy.private_directory() as directory:
        path = Path(haproxy.environment(directory)["RAY_SERVE_HAPROXY_SOCKET_PATH"])
        assert len(str(path.parent / NODE / path.name)) <= 97


@pytest.mark.usefixtures("directories")
def test_two_servers_share_nothing() -> None:
    with haproxy.private_directory() as one, haproxy.private_directory() as other:
        private = [
            {value for name, value in variables.items() if name.endswith("_PORT") or value.startswith("/")}
            for variables in map(haproxy.environment, (one, other))
        ]
        assert one.exists(), "the directory of a live server is kept"
    assert not private[0] & private[1]


def test_the_files_of_a_killed_server_are_removed(directories: Path) -> None:
    abandoned = directories / f"{haproxy.PREFIX}dead"
    abandoned.mkdir()
    (abandoned / haproxy.LOCK).touch()
    # A process named haproxy with its configuration in the directory.
    configuration = abandoned / "haproxy.cfg"
    configuration.write_text("import signal; print(flush=True); signal.pause()")
    left = subprocess.Popen(["haproxy", str(configuration)], executable=sys.executable, stdout=subprocess.PIPE)
    assert left.stdout is not None
    left.stdout.readline()
    assert haproxy.processes(abandoned) == [left.pid]
    with haproxy.private_directory():
        assert left.wait(10) != 0
        assert not abandoned.exists()
    left.stdout.close()


SERVER = """
import signal, subprocess, sys
from pathlib import Path
from serve_app.runtime import haproxy

folder, binary, text = sys.argv[1:]
haproxy.DIRECTORIES = Path(folder)
with haproxy.private_directory() as directory:
    configuration = directory / "haproxy.cfg"
    configuration.write_text(text)
    subprocess.Popen([binary, "-db", "-f", configuration])
    signal.pause()
"""
ANSWERING = """defaults
    mode http
    timeout connect 1s
    timeout client 10s
    timeout server 10s
frontend http_frontend
    bind 127.0.0.1:{port}
    http-request return status 503
"""


def test_a_killed_server_leaves_neither_haproxy_nor_files(directories: Path) -> None:
    (port,) = haproxy.free_ports(1, "127.0.0.1")
    arguments = (str(directories), BINARY, ANSWERING.format(port=port))
    with subprocess.Popen([sys.executable, "-c", SERVER, *arguments]) as server:
        until(lambda: not haproxy.is_free("127.0.0.1", port))
        server.kill()
    until(lambda: haproxy.is_free("127.0.0.1", port), seconds=60)
    until(lambda: not list(directories.iterdir()), seconds=60)


@pytest.mark.timeout(60)
def test_directories_of_other_users_are_not_opened(directories: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Opening a pipe would block, and the content of a file would be trusted."""
    foreign = directories / f"{haproxy.PREFIX}foreign"
    foreign.mkdir()
    os.mkfifo(foreign / haproxy.LOCK)
    (foreign / haproxy.GRPC_PORT_FILE).write_text("not a port")
    (directories / f"{haproxy.PREFIX}link").symlink_to(foreign)
    monkeypatch.setattr(os, "geteuid", lambda: foreign.stat().st_uid + 1)
    with haproxy.private_directory() as directory:
        haproxy.environment(directory)
    assert (foreign / haproxy.LOCK).is_fifo()


def test_free_ports_are_free(monkeypatch: pytest.MonkeyPatch) -> None:
    (port,) = haproxy.free_ports(1, "127.0.0.1")
    with socket.create_server(("127.0.0.1", port)):
        assert not haproxy.is_free("127.0.0.1", port)
    assert len(set(haproxy.free_ports(5))) == 5
    monkeypatch.setattr(haproxy, "is_free", lambda *_: False)
    with pytest.raises(NotReady, match="fewer than 2 free ports"):
        haproxy.free_ports(2)


@needs_ipv6
def test_ports_of_ipv6_addresses_may_be_in_use() -> None:
    (port,) = haproxy.free_ports(1, "::1")
    with socket.create_server(("::1", port), family=socket.AF_INET6):
        assert not haproxy.is_free("::1", port)


def test_the_reason_why_no_server_can_listen_is_reported(subtests: pytest.Subtests) -> None:
    """A port in use is another matter: a server can listen on the next one."""
    elsewhere = "expected an address or a name of this machine"
    for host, port, message in (
        ("203.0.113.1", 8000, "cannot listen on port 8000 of 203.0.113.1: Cannot assign requested address"),
        ("2001:db8::1", 8000, "cannot listen on port 8000 of 2001:db8::1: Cannot assign requested address"),
        ("127.0.0.1:8620", 8000, f"cannot listen on 127.0.0.1:8620: Name or service not known; {elsewhere}"),
        ("a..b", 8000, f"cannot listen on a..b: not a host name; {elsewhere}"),
        ("127.0.0.1", 0, "a port must be from 1 to 65535, got 0"),
        ("127.0.0.1", 65_536, "a port must be from 1 to 65535, got 65536"),
    ):
        with subtests.test(host=host, port=port), pytest.raises(ConfigError) as caught:
            haproxy.is_free(host, port)
        assert str(caught.value) == message
    with pytest.raises(ConfigError, match=r"cannot listen on port \d+ of 203\.0\.113\.1"):
        haproxy.free_ports(1, "203.0.113.1")


@pytest.mark.usefixtures("directories")
def test_servers_that_start_at_the_same_time_do_not_draw_the_same_ports() -> None:
    claimed: list[int] = []
    with ExitStack() as servers:
        for _ in range(5):
            variables = haproxy.environment(servers.enter_context(haproxy.private_directory()))
            ports = {name: int(value) for name, value in variables.items() if "PORT" in name and value.isdigit()}
            first, _last = (ports.pop(f"RAY_SERVE_DIRECT_INGRESS_{end}_GRPC_PORT") for end in ("MIN", "MAX"))
            drawn = range(first + haproxy.DISTANCE, first + haproxy.DISTANCE + haproxy.GRPC_PORTS.step)
            assert len(ports) == len({*ports.values()} & {*drawn}) == 4
            assert not {*drawn} & {*haproxy.PORTS}
            claimed.append(first)
    assert len(set(claimed)) == 5


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
    """From a stand-in, and from an HAProxy of Ray that knows no replica, and has no port of the server."""
    http, metrics, stats = haproxy.free_ports(3, "127.0.0.1")
    wrapper = haproxy_script.install(tmp_path, BINARY, stats, metrics)
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
        (tmp_path / "standin.cfg").write_text(ANSWERING.format(port=http))
        stand_in = subprocess.Popen([BINARY, "-db", "-f", tmp_path / "standin.cfg"])
        processes.callback(stand_in.wait)
        processes.callback(stand_in.kill)
        (tmp_path / haproxy_script.STAND_IN).write_text(str(stand_in.pid))
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


COMMAND = str(Path(sys.executable).with_name(haproxy_script.COMMAND))
ENVIRONMENT = os.environ | {haproxy_script.BINARY_PATH: COMMAND}
"""The environment of a node, in which Ray's HAProxy is the command itself."""
LOG = "    log 127.0.0.1:514 local0 info\n"
LIMITED = f"""global
{LOG}    maxconn 16384
defaults
    mode http
    log global
    option httplog
    timeout client 60s
    timeout connect 5s
    timeout server 5s
frontend prometheus
    bind :{{metrics}}
frontend http_frontend
    bind 127.0.0.1:1
listen stats
    bind *:{{stats}}
"""


def test_a_node_has_the_limits(tmp_path: Path) -> None:
    configuration = tmp_path / "haproxy.cfg"
    ports = {"RAY_SERVE_HAPROXY_STATS_PORT": "8500", "RAY_SERVE_HAPROXY_METRICS_PORT": "8501"}
    logs = {haproxy_script.LOG_TARGET: "127.0.0.1:514"}
    # `-c` starts nothing.
    command = [COMMAND, "-db", "-f", str(configuration), "-c"]
    for environment, stats, metrics in (({}, 8404, 9101), (ports | logs, 8500, 8501)):
        configuration.write_text(LIMITED.format(stats=stats, metrics=metrics))
        checked = subprocess.run(command, env=ENVIRONMENT | environment, capture_output=True, text=True, timeout=60)
        assert checked.returncode == 0, checked.stderr
        amended = configuration.read_text()
        assert "timeout tunnel 3600s" in amended, "idle WebSockets would end with the timeout of a request"
        assert "timeout http-request 10s" in amended
        assert "option http-buffer-request" in amended
        assert "timeout check 5s" in amended, "a busy replica has more time than the interval of health checks"
        assert f"bind 127.0.0.1:{stats}" in amended, "statistics are for this machine only"
        assert f"bind 127.0.0.1:{metrics}" in amended
        assert (LOG in amended) == (haproxy_script.LOG_TARGET in environment), "a line for each request"
    process = subprocess.run([COMMAND, "-v"], env=ENVIRONMENT, capture_output=True, text=True, timeout=60)
    assert (process.returncode, process.stdout[:15]) == (0, "HAProxy version"), "without a configuration"


def installed(directory: Path) -> Path:
    """The command, with a HAProxy that does nothing."""
    binary = directory / "binary"
    binary.write_text("#!/bin/sh\n")
    binary.chmod(0o700)
    return haproxy_script.install(directory, str(binary), 8404, 9101)


def test_a_node_accepts_the_connections_for_which_it_has_descriptors(tmp_path: Path) -> None:
    configuration, wrapper = tmp_path / "haproxy.cfg", installed(tmp_path)
    script = wrapper.read_text()
    for descriptors, connections in ((1_000, 320), (20_000, 7_920), (50_000, 16_384)):
        configuration.write_text(LIMITED.format(stats=8404, metrics=9101))
        # A limit can only be lowered: the shell reports the one of the test.
        wrapper.write_text(script.replace("\n", f"\nulimit() {{ echo {descriptors}; }}\n", 1))
        subprocess.run([str(wrapper), "-f", str(configuration)], check=True, timeout=60)
        assert f"    maxconn {connections}\n" in configuration.read_text()


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
    return subprocess.run(["pgrep", "-f", f"{directory}/"], capture_output=True, text=True, timeout=60).stdout


def test_the_last_known_replicas_are_kept_while_the_controller_finds_them_again(tmp_path: Path) -> None:
    """A restarted controller that needs more than ten seconds for that announces an application without replicas."""
    configuration, wrapper = tmp_path / "haproxy.cfg", installed(tmp_path)

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


LISTENING = """frontend http_frontend
    bind {host}:8000
backend http-league
    server here 127.0.0.1:30000 check observe layer4
    server elsewhere 10.0.0.8:30000 check observe layer4
    server fallback 127.0.0.1:8500 check backup
frontend grpc_frontend
    bind {host}:8001 proto h2
backend grpc-league
    server here 127.0.0.1:30001 proto h2 check observe layer4
"""


def test_haproxy_calls_replicas_where_they_listen(tmp_path: Path, subtests: pytest.Subtests) -> None:
    """Their HTTP servers listen on the host of the server, those of gRPC on loopback or on all interfaces."""
    configuration, wrapper = tmp_path / "haproxy.cfg", installed(tmp_path)
    for host, address in (
        ("127.0.0.1", "127.0.0.1"),
        ("*", "127.0.0.1"),
        ("localhost", "127.0.0.1"),
        ("10.0.0.7", "10.0.0.7"),
        ("::1", "::1"),
        ("FD00::2", "FD00::2"),
        (haproxy_script.ALL_OF_IPV6, "::1"),
    ):
        with subtests.test(host=host):
            configuration.write_text(LISTENING.format(host=host))
            subprocess.run([str(wrapper), "-f", str(configuration)], check=True, timeout=60)
            lines = configuration.read_text().splitlines()
            assert [line.split()[2] for line in lines if line.startswith("    server ")] == [
                f"{address}:30000",
                "10.0.0.8:30000",
                f"{address}:8500",
                "127.0.0.1:30001",
            ]


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
def proxy(directory: Path, replica: int, settings: str = "") -> Iterator[str]:
    """HAProxy in front of a replica's port, started as Ray starts it. Yields its URL."""
    (port,) = haproxy.free_ports(1, "127.0.0.1")
    configuration = directory / "haproxy.cfg"
    configuration.write_text(settings + PROXY.format(directory=directory, port=port, replica=replica))
    with subprocess.Popen(
        [COMMAND, "-db", "-f", str(configuration)], env=ENVIRONMENT, stderr=subprocess.DEVNULL
    ) as process:
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
    assert response.headers.get_list("x-content-type-options") == ["nosniff"]
    document: dict[str, str] = response.json()
    assert document["error"] == document["message"], "the field of /v2 is that of /v1"
    return {"status": str(response.status_code), "code": document["code"]}


def test_errors_of_haproxy_are_those_of_the_api(tmp_path: Path) -> None:
    path = "/v2/models/board/infer"
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
        refusal = refused(tmp_path, "/v1/leagues", replica.getsockname()[1])
        replica.shutdown(socket.SHUT_RDWR)
    assert refusal == {"status": "502", "code": "replica_lost"}


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

    limit = f"global\n    maxconn {CONNECTIONS}\n"
    with serving(answer, "uvloop") as (_, replica), proxy(directory, replica, limit) as url:
        yield "127.0.0.1", int(url.rpartition(":")[2])


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
            assert reply.count(b"\r\nx-content-type-options: nosniff\r\n") == 1, "that of the replica is replaced"
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
