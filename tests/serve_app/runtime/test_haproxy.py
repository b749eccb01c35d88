"""Each server has its own HAProxy: its files, its ports, and its end."""

import os
import socket
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path

import pytest

from league.errors import NotReady
from serve_app.runtime import haproxy

NODE = "n" * 56
"""The directory that Ray inserts between HAProxy's directory and its socket."""


@pytest.fixture(autouse=True)
def directories(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(haproxy, "DIRECTORIES", tmp_path)
    return tmp_path


def test_the_directory_exists_while_the_context_lasts(directories: Path) -> None:
    with haproxy.private_directory() as directory:
        assert directory.stat().st_mode & 0o077 == 0, "the directory is private"
    assert list(directories.iterdir()) == []


def test_the_path_of_the_socket_is_short_enough_for_haproxy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    with haproxy.private_directory() as directory:
        path = Path(haproxy.environment(directory)["RAY_SERVE_HAPROXY_SOCKET_PATH"])
        assert len(str(path.parent / NODE / path.name)) <= 97


def test_two_servers_share_nothing() -> None:
    with haproxy.private_directory() as one, haproxy.private_directory() as other:
        private = [
            {
                value
                for name, value in haproxy.environment(directory).items()
                if name.endswith("_PORT") or value.startswith("/")
            }
            for directory in (one, other)
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


def test_free_ports_are_free() -> None:
    (port,) = haproxy.free_ports(1, "127.0.0.1")
    with socket.socket() as server:
        server.bind(("127.0.0.1", port))
        server.listen()
        assert not haproxy.is_free("127.0.0.1", port)
    assert len(set(haproxy.free_ports(5))) == 5


def test_servers_that_start_at_the_same_time_do_not_draw_the_same_ports(directories: Path) -> None:
    claimed: list[int] = []
    with ExitStack() as servers:
        for _ in range(5):
            variables = haproxy.environment(servers.enter_context(haproxy.private_directory()))
            ports = {name: int(value) for name, value in variables.items() if "PORT" in name and value.isdigit()}
            first, _last = (ports.pop(f"RAY_SERVE_DIRECT_INGRESS_{end}_GRPC_PORT") for end in ("MIN", "MAX"))
            own = range(first + haproxy.DISTANCE, first + haproxy.DISTANCE + haproxy.GRPC_PORTS.step)
            assert len(ports) == len({*ports.values()} & {*own}) == 4
            assert not {*own} & {*haproxy.PORTS}
            claimed.append(first)
    assert len(set(claimed)) == 5


def test_missing_free_ports_are_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(haproxy, "is_free", lambda *_: False)
    with pytest.raises(NotReady, match="fewer than 2 free ports"):
        haproxy.free_ports(2)
