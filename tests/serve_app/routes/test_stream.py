"""Streams whose replica stops, or that HAProxy will cut, are closed one after the other so that they reconnect."""

import json

import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from league.registry.registry import Registry
from serve_app.routes import stream
from serve_app.routes.stream import ClosingTimes
from tests.support.servers.streaming import Listening, listening
from tests.support.waiting import until

ONE = json.dumps({"observation": [1]})


def opened(listener: Listening, model: str = "memory") -> ClientConnection:
    return connect(listener.stream(model), compression=None, proxy=None)


def closing(connection: ClientConnection) -> tuple[int, dict[str, object] | None]:
    """The close code of a stream, and the message before it."""
    last = None
    try:
        while True:
            last = json.loads(connection.recv(20))
    except ConnectionClosed as end:
        return end.rcvd.code if end.rcvd else 1006, last


@pytest.mark.parametrize("change", ["added", "removed", "drained"])
def test_open_streams_reconnect_when_the_number_of_replicas_has_changed(
    registry: Registry, monkeypatch: pytest.MonkeyPatch, change: str
) -> None:
    monkeypatch.setattr(stream, "AFTER_CHANGE", ClosingTimes(0.0, 0.1))
    if change != "added":
        registry.replicas.register("replica-2", {})
    with listening(registry.storage) as listener, opened(listener) as one, opened(listener) as other:
        for connection in (one, one, other, other):
            connection.send(ONE)
            assert json.loads(connection.recv(20))["action"] == 0  # the third one would be 1
        if change == "added":
            registry.replicas.register("replica-2", {})
        elif change == "removed":
            registry.replicas.remove("replica-2")
        else:
            registry.replicas.register("replica-2", {}, is_draining=True)
        for connection in (one, other):
            code, last = closing(connection)
            assert code == 1012
            assert last is not None
            assert last["closing"]
        with opened(listener) as again:
            again.send(json.dumps({"observation": [1], "state": last["state"]}))
            assert json.loads(again.recv(20))["action"] == 1


def test_streams_stay_open_when_a_drained_replica_ends(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    """They reconnected when it began to drain."""
    monkeypatch.setattr(stream, "AFTER_CHANGE", ClosingTimes(0.0, 0.1))
    registry.replicas.register("replica-2", {}, is_draining=True)
    with listening(registry.storage) as listener, opened(listener) as connection:
        for _ in range(2):
            connection.send(ONE)
            assert json.loads(connection.recv(20))["action"] == 0
        registry.replicas.remove("replica-2")
        for _ in range(2):
            last = registry.replicas.registered()[0].seen_at
            until(lambda last=last: registry.replicas.registered()[0].seen_at > last)
        assert listener.server.stream._closings == {}
        connection.send(ONE)
        assert json.loads(connection.recv(20))["action"] == 1


def test_streams_of_a_replica_that_stops_are_closed_earlier(
    registry: Registry, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stream, "AFTER_CHANGE", ClosingTimes(300.0, 400.0))
    monkeypatch.setattr(stream, "WHILE_DRAINING", ClosingTimes(0.0, 0.1))
    with listening(registry.storage) as listener, opened(listener) as connection:
        registry.replicas.register("replica-2", {})
        connection.send(ONE)
        connection.recv(20)
        monkeypatch.setattr(listener.server.stream, "_is_draining", lambda: True)
        assert closing(connection)[0] == 1012
