"""Machines of a test cluster are killed, cut off and started again."""

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.cluster import machines
from tests.support.cluster.machines import Machine, network
from tests.support.waiting import until

pytestmark = pytest.mark.slow

PORT = 7000
LISTEN = "import socket; s = socket.create_server(('{}', {}))\nwhile True: s.accept()[0].sendall(b'here')"
CONNECT = "import socket; s = socket.create_connection(('{}', {}), 1); print(s.recv(4).decode(), end='')"


@pytest.fixture
def pair(tmp_path: Path) -> Iterator[tuple[Machine, Machine]]:
    """A server and a client."""
    if (reason := machines.obstacle()) is not None:
        pytest.skip(reason)
    with network(["server", "client"], tmp_path) as members:
        yield members["server"], members["client"]


def test_a_machine_is_cut_off_killed_and_started_again(pair: tuple[Machine, Machine]) -> None:
    server, client = pair

    def listen() -> None:
        server.start(sys.executable, "-c", LISTEN.format(server.address, PORT))

    def answers() -> bool:
        return client.run(sys.executable, "-c", CONNECT.format(server.address, PORT)).stdout == "here"

    listen()
    until(answers)
    with server.unplugged():
        assert not answers()
    until(answers)
    server.kill()
    assert not answers()
    server.boot(server.switch)
    listen()
    until(answers)


def test_machines_share_no_files_but_those_of_the_project(pair: tuple[Machine, Machine], tmp_path: Path) -> None:
    server, client = pair
    server.check_run("touch", "/tmp/private", str(tmp_path / "shared"))
    assert client.run("ls", "/tmp/private").returncode != 0
    assert client.run("ls", str(tmp_path / "shared")).returncode == 0
    assert not Path("/tmp/private").exists()
    assert client.check_run("hostname") == "client\n"
