"""What waits to be accepted is seen without accepting it, and a socket is left as it is."""

import socket
from time import monotonic

from serve_app.accept_queue import AcceptQueue


def test_connections_that_were_not_accepted_are_counted() -> None:
    with socket.create_server(("127.0.0.1", 0), backlog=16) as server:
        address = server.getsockname()
        queue = AcceptQueue(address[1])
        assert queue.length() == 0
        waiting = [socket.create_connection(address) for _ in range(5)]
        deadline = monotonic() + 10
        while queue.length() < 5:
            assert monotonic() < deadline
        server.accept()[0].close()
        assert queue.length() == 4
        for connection in waiting:
            connection.close()
        del queue
        with socket.create_connection(address):
            server.accept()[0].close()


def test_a_socket_that_was_closed_is_not_kept_listening() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        queue = AcceptQueue(server.getsockname()[1])
        address = server.getsockname()
    assert queue.length() == 0
    with socket.socket() as probe:
        assert probe.connect_ex(address) != 0


def test_where_nobody_listens_nothing_waits() -> None:
    with socket.socket() as bound:
        bound.bind(("127.0.0.1", 0))
        assert AcceptQueue(bound.getsockname()[1]).length() == 0
