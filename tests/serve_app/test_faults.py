"""The real thing, hurt in every way: what callers see of it, and whether it recovers."""

import asyncio
import os
import shutil
import signal
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import pytest
import yaml

from benchmarks.load import post
from benchmarks.slow_clients import slow_clients
from league.client import Client
from league.registry.registry import Registry
from league.settings import Storage
from serve_app.launch import DEPLOY_YAML, running
from tests.serve_app.leagues import everything, promote
from tests.serve_app.test_action import BOARD
from tests.serve_app.test_server import ACTION, Load, load, processes, serving, until

SETTINGS = {"max_waiting": 8, "patience": 0.01}
"""More than the clients here fill, less than those do who overrun it."""


@pytest.fixture(scope="module")
def registry(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Registry]:
    registry = everything(Storage.at(tmp_path_factory.mktemp("hurt") / "home"))
    yield registry
    registry.close()


@pytest.fixture(scope="module")
def url(registry: Registry) -> Iterator[str]:
    document = yaml.safe_load(DEPLOY_YAML.read_text())
    document["applications"][0]["args"] = SETTINGS
    deploy = registry.storage.home / "deploy.yaml"
    deploy.write_text(yaml.safe_dump(document))
    with running(registry.storage, replicas=2, deploy=deploy) as url:
        until(lambda: serving(registry, 1) == 2)
        yield url


@contextmanager
def under_load(url: str) -> Iterator[Load]:
    """Our client calls without a pause; afterwards not one of its calls has failed."""

    def caller() -> Callable[[], int]:
        client = Client(url)
        return lambda: client.act("board", BOARD).version

    with load(caller, callers=4) as seen:
        more(seen)
        yield seen
        more(seen)
    assert seen.failures == []


def more(seen: Load, calls: int = 100) -> None:
    """Wait until so many more calls were answered."""
    before = seen.versions.total()
    until(lambda: seen.versions.total() > before + calls)


def kill(registry: Registry, name: str, count: int | None = None) -> None:
    """Kill processes of the server; return when as many new ones are there."""
    before = processes(registry.storage, name)
    victims = before[:count]
    assert victims
    for pid in victims:
        os.kill(pid, signal.SIGKILL)
    until(lambda: len(set(processes(registry.storage, name)) - set(victims)) >= len(before))


def follows(registry: Registry, version: int) -> None:
    """Every replica serves a version that is promoted now."""
    promote(registry, "board", version)
    until(lambda: serving(registry, version) >= 2)


def haproxies(registry: Registry) -> list[int]:
    """HAProxy itself, not Ray's process that starts it."""
    return processes(registry.storage, "bin/haproxy")


def test_a_replica(url: str, registry: Registry) -> None:
    with under_load(url):
        kill(registry, "PolicyServer", 1)
        follows(registry, 2)


def test_the_controller(url: str, registry: Registry) -> None:
    with under_load(url):
        kill(registry, "ServeController")


def test_haproxy_is_stood_in_for_and_replaced(url: str, registry: Registry) -> None:
    victims = haproxies(registry)
    with under_load(url) as seen:
        for pid in victims:
            os.kill(pid, signal.SIGKILL)
        until(lambda: set(haproxies(registry)) - set(victims))
        more(seen)
        until(lambda: any(b"standin.cfg" not in line for line in lines(haproxies(registry))))
        until(lambda: all(b"standin.cfg" not in line for line in lines(haproxies(registry))))


def lines(pids: list[int]) -> list[bytes]:
    return [Path(f"/proc/{pid}/cmdline").read_bytes() for pid in pids if Path(f"/proc/{pid}").exists()]


def test_a_database_that_is_moved_away(url: str, registry: Registry) -> None:
    path = registry.storage.home / "league.db"
    with under_load(url) as seen, httpx.Client(base_url=url) as client:
        path.rename(path.with_name("away"))
        until(lambda: client.get("/v1/leagues").json().get("code") == "storage_error")
        assert client.get("/v1/leagues").status_code == 503
        assert client.get("/v1/health/ready").status_code == 200
        kill(registry, "PolicyServer", 1)  # the one that comes instead must not make a database of its own
        more(seen, 500)
        assert not path.exists()
        path.with_name("away").rename(path)
        follows(registry, 3)
        until(lambda: client.get("/v1/leagues").status_code == 200)
        assert client.post(ACTION, json={"observation": BOARD}).json()["version"] == 3


def test_a_database_that_is_locked(url: str, registry: Registry) -> None:
    blocker = sqlite3.connect(registry.storage.home / "league.db", isolation_level=None)
    with under_load(url) as seen, httpx.Client(base_url=url) as client:
        blocker.execute("BEGIN EXCLUSIVE")
        more(seen, 500)
        assert client.get("/v1/leagues").status_code == 200, "who reads waits for nobody"
        assert client.get("/v1/health/ready").status_code == 200
        blocker.execute("ROLLBACK")
        follows(registry, 1)
    blocker.close()


def test_the_artefact_of_the_version_that_answers(url: str, registry: Registry) -> None:
    follows(registry, 1)
    path = registry.artifacts.path("board", 1)
    with under_load(url) as seen, httpx.Client(base_url=url) as client:
        shutil.copytree(path, path.with_name("kept"))
        shutil.rmtree(path)
        more(seen, 500)
        assert client.post(ACTION, json={"observation": BOARD}).json()["version"] == 1
        follows(registry, 2)
        path.with_name("kept").rename(path)
    assert seen.versions.keys() == {1, 2}


def test_slow_clients_stop_nobody(url: str) -> None:
    request = post(f"{url}{ACTION}", httpx.Request("POST", url, json={"observation": BOARD}).content)
    with under_load(url) as seen, slow_clients(f"{url}{ACTION}", request, 300):
        more(seen, 1000)


def test_who_comes_too_often_is_told_to_come_back(url: str) -> None:
    """Batches cost the server more than the callers, so that a queue stands."""
    seen: set[tuple[int, str | None]] = set()

    async def overrun() -> None:
        request = httpx.Request("POST", f"{url}{ACTION}", json={"observations": [BOARD] * 200})
        async with httpx.AsyncClient(timeout=30) as client:

            async def insist() -> None:
                while (429, "1") not in seen:
                    reply = await client.send(request)
                    seen.add((reply.status_code, reply.headers.get("retry-after")))

            await asyncio.gather(*(insist() for _ in range(48)))

    with under_load(url):
        asyncio.run(asyncio.wait_for(overrun(), 60))
    assert seen == {(200, None), (429, "1")}
