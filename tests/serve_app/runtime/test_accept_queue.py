"""The accept queue can be read without accepting connections, and without changes to the socket."""

import socket
from functools import partial

from serve_app.runtime.uvicorn_http import AcceptQueue
from tests.support.waiting import until


def has_length(queue: AcceptQueue, length: int) -> bool:
    return queue.length() == length


def test_waiting_connections_are_counted() -> None:
    with socket.create_server(("127.0.0.1", 0), backlog=16) as server:
        address = server.getsockname()
        queue = AcceptQueue(address[1])
        assert queue.length() == 0
        connections = [socket.create_connection(address) for _ in range(5)]
        until(partial(has_length, queue, 5))
        server.accept()[0].close()
        assert queue.length() == 4
        for connection in connections:
            connection.close()
        del queue
        with socket.create_connection(address):
            server.accept()[0].close()


def test_a_closed_socket_is_not_kept_listening() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        queue = AcceptQueue(server.getsockname()[1])
        address = server.getsockname()
    assert queue.length() == 0
    with socket.socket() as probe:
        assert probe.connect_ex(address) != 0


def test_without_a_listener_the_queue_is_empty() -> None:
    with socket.socket() as bound:
        bound.bind(("127.0.0.1", 0))
        assert AcceptQueue(bound.getsockname()[1]).length() == 0


def test_connections_are_accepted_in_order() -> None:
    with socket.create_server(("127.0.0.1", 0), backlog=16) as server:
        server.setblocking(False)
        queue = AcceptQueue(server.getsockname()[1])
        assert queue.take() is None
        connections = [socket.create_connection(server.getsockname()) for _ in range(3)]
        until(partial(has_length, queue, 3))
        for connection in connections:
            taken = queue.take()
            assert taken is not None
            assert taken.getpeername() == connection.getsockname()
            assert not taken.getblocking()
            taken.close()
            connection.close()
        assert queue.take() is None
