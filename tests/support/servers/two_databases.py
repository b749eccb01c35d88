"""Two replicas of equal leagues, one with SQLite and one with PostgreSQL, whose responses are compared."""

from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import httpx
from sqlalchemy import select
from starlette.testclient import TestClient

from league.registry.keys import SCOPES
from league.registry.registry import Registry
from league.registry.storage.tables import ReplicaTable
from league.settings import Storage
from serve_app.app import Replica
from tests.support.leagues.match_results import record
from tests.support.leagues.protocol_leagues import every_kind
from tests.support.servers import postgresql
from tests.support.servers.replicas import READ_ONLY, UnavailableEvaluation, local_client
from tests.support.waiting import until

POLLING = READ_ONLY.model_copy(update={"poll": 0.1, "poll_slowest": 0.1})


@dataclass
class ReplicasOfBoth:
    """The replicas, and a client of each with a key for all scopes."""

    servers: list[Replica] = field(default_factory=list)
    clients: list[TestClient] = field(default_factory=list)
    _has_changed: bool = False

    def responses(
        self, method: str, url: str, content: bytes | None, headers: Mapping[str, str]
    ) -> list[httpx.Response]:
        """Send a request to each replica, when all follow the change of an earlier request and have reported how many
        they answered.
        """
        for server, client in zip(self.servers, self.clients, strict=True) if self._has_changed else ():
            until(partial(_is_settled, server))
            assert client.portal is not None
            client.portal.call(server.reporter.report)
        responses = [client.request(method, url, content=content, headers=headers) for client in self.clients]
        self._has_changed = method != "GET" and not all(response.is_error for response in responses)
        return responses


@contextmanager
def replicas_of_both(directory: Path, socket: Path) -> Iterator[ReplicasOfBoth]:
    """Run the replicas. socket: directory of PostgreSQL's socket."""
    with ExitStack() as stack:
        replicas = ReplicasOfBoth()
        for database in ("sqlite", "postgresql"):
            storage = Storage.at(directory / database)
            if database == "postgresql":
                storage = replace(storage, database_url=postgresql.create(socket, "databases"))
            key = _fill(storage)
            server = Replica(Registry.open(storage), POLLING, "replica-1", evaluation_client=UnavailableEvaluation())
            client = stack.enter_context(local_client(server))
            client.headers["x-api-key"] = key
            replicas.servers.append(server)
            replicas.clients.append(client)
        yield replicas


def is_available(status: int, code: str | None) -> bool:
    """Return whether a response is not a server error. 503 is correct without a champion or an evaluation service."""
    return status < 500 or (
        status == 503 and (code in ("not_ready", "no_evaluation_service") or "no champion" in str(code))
    )


def _is_settled(server: Replica) -> bool:
    """Whether a replica has read all changes, and serves what they require."""
    registry = server.registry
    ((changes,),) = registry.database.rows(select(ReplicaTable.changes))
    has_read = (changes or 0) >= registry.changes.counts().to_acknowledge
    return has_read and not server.alias_slots.differing() and not server.traffic.differing()


def outline(response: httpx.Response) -> tuple[int, str | None, Any]:
    """Status, error code (in the Open Inference Protocol the message), and the keys and types of the document."""
    document = response.json() if "json" in response.headers.get("content-type", "") else None
    is_error = response.status_code >= 400 and isinstance(document, dict)
    code = document.get("code", document.get("error")) if is_error else None
    return response.status_code, code, _types(document)


def _types(document: Any) -> Any:
    """A document with types instead of values: times, digests and measured durations differ."""
    if isinstance(document, dict):
        # What replicas have acknowledged depends on the time, and which requests are mirrored is random.
        return {key: _types(value) for key, value in document.items() if key not in ("replicas", "shadows")}
    if isinstance(document, list):
        return [_types(value) for value in document]
    return "number" if isinstance(document, int | float) and not isinstance(document, bool) else type(document).__name__


def _fill(storage: Storage) -> str:
    registry = every_kind(storage)
    record(registry)
    _, token = registry.keys.create("databases", SCOPES)
    registry.close()
    return token
