"""A real server with injected faults: their effect on clients, and recovery."""

import asyncio
import os
import signal
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import httpx
import pytest

from benchmarks.attacks.slow_clients import slow_clients
from benchmarks.load.http import drive, post
from league.registry.registry import Registry
from league.settings import Storage
from policy_league_client import Client
from serve_app.runtime.launch import running
from tests.support.clients.actions import BOARD
from tests.support.leagues.served_leagues import everything, promote
from tests.support.servers.under_load import ACTION, Load, deploy_file, load, processes, serving
from tests.support.waiting import until

pytestmark = pytest.mark.slow

SETTINGS = {"max_wait": 0.01}
"""More than requests of these clients wait, and less than those of others that exceed it."""


@pytest.fixture(scope="module")
def registry(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Registry]:
    registry = everything(Storage.at(tmp_path_factory.mktemp("hurt") / "home"))
    yield registry
    registry.close()


@pytest.fixture(scope="module")
def url(registry: Registry) -> Iterator[str]:
    deploy = deploy_file(registry.storage.home, SETTINGS)
    with running(registry.storage, replicas=2, deploy=deploy) as url:
        until(lambda: serving(registry, 1) == 2)
        yield url


@contextmanager
def without_failures(url: str) -> Iterator[Load]:
    """Call without pause while the context lasts, and assert that no call has failed."""

    def caller() -> Callable[[], int]:
        client = Client(url, retry_deadline=60.0)  # a busy machine may replace a process slowly
        return lambda: client.act("board", BOARD).version

    with load(caller, callers=4) as result:
        wait_for_calls(result)
        yield result
        wait_for_calls(result)
    assert result.failures == []


def wait_for_calls(result: Load, calls: int = 100) -> None:
    """Wait for this number of further answers."""
    previous = result.versions.total()
    until(lambda: result.versions.total() > previous + calls)


def kill(registry: Registry, name: str, count: int | None = None) -> None:
    """Kill processes of the server; return when they have been replaced."""
    running_before = processes(registry.storage, name)
    victims = running_before[:count]
    assert victims
    for pid in victims:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    until(lambda: len(set(processes(registry.storage, name)) - set(victims)) >= len(running_before))


def promote_everywhere(registry: Registry, version: int) -> None:
    """Promote a version and wait until all replicas serve it."""
    promote(registry, "board", version)
    until(lambda: serving(registry, version) >= 2)


def haproxies(registry: Registry) -> list[int]:
    """The HAProxy processes, without Ray's process that starts them."""
    return processes(registry.storage, "bin/haproxy")


def test_a_killed_replica_is_replaced(url: str, registry: Registry) -> None:
    with without_failures(url):
        kill(registry, "PolicyServer", 1)
        promote_everywhere(registry, 2)


def test_a_killed_controller_is_replaced(url: str, registry: Registry) -> None:
    with without_failures(url):
        kill(registry, "ServeController")


def test_a_killed_haproxy_has_a_stand_in_and_is_replaced(url: str, registry: Registry) -> None:
    victims = haproxies(registry)
    with without_failures(url) as result:
        for pid in victims:
            with suppress(ProcessLookupError):  # of an earlier configuration, ended by itself
                os.kill(pid, signal.SIGKILL)
        until(lambda: set(haproxies(registry)) - set(victims))
        wait_for_calls(result)
        until(lambda: any(b"standin.cfg" not in line for line in lines(haproxies(registry))))
        until(lambda: all(b"standin.cfg" not in line for line in lines(haproxies(registry))))


def lines(pids: list[int]) -> list[bytes]:
    return [Path(f"/proc/{pid}/cmdline").read_bytes() for pid in pids if Path(f"/proc/{pid}").exists()]


def test_a_moved_database(url: str, registry: Registry) -> None:
    path = registry.storage.home / "league.db"
    with without_failures(url) as result, httpx.Client(base_url=url) as client:
        path.rename(path.with_name("away"))
        # A replica may still answer from an open connection when the other one does not.
        until(lambda: all(client.get("/v1/leagues").status_code == 503 for _ in range(8)))
        assert client.get("/v1/leagues").json()["code"] == "storage_error"
        assert client.get("/v1/health/ready").status_code == 200
        kill(registry, "PolicyServer", 1)  # its replacement must not create a new database
        wait_for_calls(result, 500)
        assert not path.exists()
        path.with_name("away").rename(path)
        promote_everywhere(registry, 3)
        until(lambda: client.get("/v1/leagues").status_code == 200)
        assert client.post(ACTION, json={"observation": BOARD}).json()["version"] == 3


def test_a_locked_database(url: str, registry: Registry) -> None:
    blocker = sqlite3.connect(registry.storage.home / "league.db", isolation_level=None)
    with without_failures(url) as result, httpx.Client(base_url=url) as client:
        blocker.execute("BEGIN EXCLUSIVE")
        wait_for_calls(result, 500)
        assert client.get("/v1/leagues").status_code == 200, "readers do not wait"
        assert client.get("/v1/health/ready").status_code == 200
        blocker.execute("ROLLBACK")
        promote_everywhere(registry, 1)
    blocker.close()


def test_slow_clients_do_not_affect_others(url: str) -> None:
    request = post(f"{url}{ACTION}", httpx.Request("POST", url, json={"observation": BOARD}).content)
    with without_failures(url) as result, slow_clients(f"{url}{ACTION}", request, 300):
        wait_for_calls(result, 1000)


def test_excess_requests_are_asked_to_retry(url: str) -> None:
    """The other connections cost the clients less than the server, so that a queue persists."""
    result: set[tuple[int, str | None]] = set()
    request = httpx.Request("POST", f"{url}{ACTION}", json={"observations": [BOARD] * 64})

    def is_running() -> bool:
        return (429, "1") not in result

    async def exceed() -> None:
        async with httpx.AsyncClient(timeout=30) as client:
            calls = drive(str(request.url), request.content, 48, lambda *_: is_running(), is_running)
            async with asyncio.TaskGroup() as tasks:
                tasks.create_task(calls)
                while is_running():
                    reply = await client.send(request)
                    result.add((reply.status_code, reply.headers.get("retry-after")))

    with without_failures(url):
        asyncio.run(asyncio.wait_for(exceed(), 60))
    assert result <= {(200, None), (429, "1")}
