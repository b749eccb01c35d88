"""A replica's application on real sockets, HTTP and gRPC, in a thread, for unmodified clients; without Ray."""

from collections.abc import Iterator

import pytest

from league.registry.registry import Registry
from league.settings import Storage
from serve_app.app import Replica
from tests.support.servers.protocol_servers import SETTINGS, InProcess, Listening


@pytest.fixture(scope="session")
def replica(leagues: Storage) -> Iterator[InProcess]:
    """A replica that serves HTTP and gRPC on the loopback interface."""
    server = Replica(Registry.open(leagues), SETTINGS, "replica-1")
    with Listening(server) as address:
        yield address
