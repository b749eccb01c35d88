"""Two replicas of equal leagues, one with SQLite and one with PostgreSQL, whose responses are compared."""

from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from starlette.testclient import TestClient

from league.settings import Storage
from tests.support.leagues.match_results import record
from tests.support.leagues.served_leagues import build_everything
from tests.support.servers import postgresql
from tests.support.servers.replicas import READ_ONLY, replica


@contextmanager
def replicas_of_both(directory: Path, socket: Path) -> Iterator[list[TestClient]]:
    """Run the replicas; yields clients with a key for all scopes. socket: directory of PostgreSQL's socket."""
    with ExitStack() as stack:
        clients = []
        for database in ("sqlite", "postgresql"):
            storage = Storage.at(directory / database)
            if database == "postgresql":
                storage = replace(storage, database_url=postgresql.create(socket, "databases"))
            key = _fill(storage)
            clients.append(stack.enter_context(replica(storage, READ_ONLY)))
            clients[-1].headers["x-api-key"] = key
        yield clients


def outline(
    replicas: list[TestClient], method: str, url: str, content: bytes | None, headers: Mapping[str, str]
) -> list[Any]:
    """Send a request to each replica; returns status, error code (in the
    Open Inference Protocol the message), and the keys and types of the document, of each."""
    responses = [client.request(method, url, content=content, headers=headers) for client in replicas]
    found = []
    for response in responses:
        document = response.json() if "json" in response.headers.get("content-type", "") else None
        is_error = response.status_code >= 400 and isinstance(document, dict)
        code = document.get("code", document.get("error")) if is_error else None
        found.append((response.status_code, code, _types(document)))
    return found


def is_available(status: int, code: str | None) -> bool:
    """Return whether a response is not a server error. 503 is correct without a champion or an evaluation service."""
    return status < 500 or (
        status == 503 and (code in ("not_ready", "no_evaluation_service") or "no champion" in str(code))
    )


def _types(document: Any) -> Any:
    """A document with types instead of values: times, digests and measured durations differ."""
    if isinstance(document, dict):
        # What replicas have acknowledged depends on the time.
        return {key: _types(value) for key, value in document.items() if key != "replicas"}
    if isinstance(document, list):
        return [_types(value) for value in document]
    return "number" if isinstance(document, int | float) and not isinstance(document, bool) else type(document).__name__


def _fill(storage: Storage) -> str:
    registry = build_everything(storage)
    record(registry)
    _, token = registry.keys.create("databases", ["act", "read", "evaluate", "promote"])
    registry.close()
    return token
