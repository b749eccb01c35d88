"""Versions in an object store (moto, S3 on loopback): kills of publishers, bytes that a replica receives, cached loads.

A publisher is killed at a random time after it has begun to write, again and again. Every version that is visible
afterwards is downloaded and verified. A replica with an empty cache loads a version of 1 MB that has a large training
state; a proxy counts the bytes that it receives. Further loads read the cache, and are compared with
loads of the same version from a directory.
"""

import os
import random
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from statistics import median

from benchmarks.footprint import LARGE
from benchmarks.harness import Quick, Target
from benchmarks.leagues.served_league import LEAGUE, builder, fill
from league.registry.registry import Registry
from league.registry.storage.exports import exported_files, write_files
from league.registry.storage.manifest import Manifest
from league.settings import Storage
from serve_app.live_versions.policies import ActionSelections
from serve_app.live_versions.version_cache import load
from tests.support.leagues.registries import verified
from tests.support.servers import object_store

KILLS, LATEST_KILL = 100, 0.04
"""Number, and the latest time after a publisher has begun, in seconds."""
TRAINING_STATE = 300
"""MB."""
TO_READ, TO_TRANSFER = 20.0, 2.0
"""Milliseconds, and MB."""
INLINE = 0.001

PUBLISHER = """
import shutil, sys
from pathlib import Path
from league.registry.registry import Registry
from league.registry.storage.manifest import Manifest
from league.settings import Storage

home, database, url, files, league, source = sys.argv[1:]
registry = Registry.open(Storage(Path(home), database, url))
manifest = Manifest.from_json((Path(files) / "manifest.json").read_bytes(), "manifest")

def build(directory, number):
    print("begun", flush=True)
    shutil.copytree(files, directory, dirs_exist_ok=True)
    return manifest.model_copy(update={"version": number})

registry.publisher.publish(league, build, source=source)
"""


def main(quick: Quick = False) -> Iterator[Target]:
    """Kill publishers, and load versions."""
    with object_store.server() as endpoint, tempfile.TemporaryDirectory() as name:
        os.environ |= object_store.variables(endpoint)
        yield _kills(Path(name) / "kills", object_store.create_bucket(endpoint), 5 if quick else KILLS)
        yield from _loads(Path(name) / "loads", endpoint, 20 if quick else TRAINING_STATE)


def _kills(home: Path, url: str, times: int) -> Target:
    registry = fill(_registry(home, url), 1, LARGE)
    files, delays = _prepared(registry, home / "prepared"), random.Random(0)
    for i in range(times):
        arguments = [str(home), registry.storage.database_url, url, str(files), LEAGUE, f"run/{i}"]
        publisher = subprocess.Popen([sys.executable, "-c", PUBLISHER, *arguments], stdout=subprocess.PIPE)
        assert publisher.stdout is not None
        publisher.stdout.readline()
        with suppress(subprocess.TimeoutExpired):
            publisher.wait(delays.uniform(0, LATEST_KILL))
        publisher.kill()
        publisher.wait()
        publisher.stdout.close()
    visible = registry.versions.all(LEAGUE)
    partial = sum(not _is_complete(registry, version.number) for version in visible)
    note = f"{times - len(visible) + 1} of {times} publishers killed before their version was ready"
    return Target("partial versions visible", partial, at_most=0, note=note)


def _is_complete(registry: Registry, number: int) -> bool:
    try:
        verified(registry, number, LEAGUE)
    except Exception as error:
        print(error)
        return False
    return True


def _prepared(registry: Registry, target: Path) -> Path:
    """The files of version 1, with a training state of 2 MB."""
    write_files(exported_files(registry.versions.get(LEAGUE, 1), registry.artifacts), target)
    (target / "training").mkdir()
    (target / "training" / "state").write_bytes(os.urandom(2 * 10**6))
    return target


def _loads(home: Path, endpoint: str, megabytes: int) -> Iterator[Target]:
    url = object_store.create_bucket(endpoint)
    versions = fill(_registry(home / "publisher", url), 1, LARGE)
    number = versions.publisher.publish(LEAGUE, _with_training(versions, megabytes), source="large").number
    database = versions.storage.database_url
    proxy = CountingProxy(endpoint)
    os.environ |= object_store.variables(proxy.url)
    replica = Storage(home / "replica", database, url)
    registry = Registry.open(replica)
    load(registry, LEAGUE, number, INLINE, ActionSelections())
    received = proxy.received / 1e6
    cached = _times(lambda: load(registry, LEAGUE, number, INLINE, ActionSelections()))
    again = proxy.received / 1e6 - received
    os.environ |= object_store.variables(endpoint)
    directory = fill(Registry.open(Storage.at(home / "directory")), 1, LARGE)
    local = _times(lambda: load(directory, LEAGUE, 1, INLINE, ActionSelections()))
    note = f"training state of {megabytes} MB; cached loads {again:.2f} MB"
    yield Target("received for a version of 1 MB", round(received, 2), "MB", at_most=TO_TRANSFER, note=note)
    (wall, cpu), (of_directory, _) = (
        [median(column) for column in zip(*rows, strict=True)] for rows in (cached, local)
    )
    note = f"{cpu:.1f} ms of processor time; from a directory {of_directory:.1f} ms"
    yield Target("cached load with warm-up", round(wall, 1), "ms", at_most=TO_READ, note=note)


def _with_training(registry: Registry, megabytes: int) -> Callable[[Path, int], Manifest]:
    policies = builder(registry, 1, LARGE)

    def build(directory: Path, number: int) -> Manifest:
        (directory / "training").mkdir()
        (directory / "training" / "state").write_bytes(os.urandom(megabytes * 10**6))
        return policies(directory, number)

    return build


def _registry(home: Path, url: str) -> Registry:
    return Registry.open(Storage(home, Storage.at(home).database_url, url))


def _times(function: Callable[[], object], times: int = 20) -> list[tuple[float, float]]:
    """Time and processor time of calls in milliseconds."""
    durations = []
    for _ in range(times):
        start, cpu = time.perf_counter(), time.process_time()
        function()
        durations.append(((time.perf_counter() - start) * 1e3, (time.process_time() - cpu) * 1e3))
    return durations


class CountingProxy:
    """Forwards TCP connections to an endpoint and counts the bytes of its responses in `received`."""

    def __init__(self, endpoint: str) -> None:
        host, _, port = endpoint.removeprefix("http://").partition(":")
        self._target = (host, int(port))
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.url = f"http://127.0.0.1:{self._listener.getsockname()[1]}"
        self.received = 0
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        while True:
            client, _ = self._listener.accept()
            server = socket.create_connection(self._target)
            for source, target, counts in ((client, server, False), (server, client, True)):
                threading.Thread(target=self._forward, args=(source, target, counts), daemon=True).start()

    def _forward(self, source: socket.socket, target: socket.socket, counts: bool) -> None:
        with suppress(OSError):
            while data := source.recv(65536):
                if counts:
                    self.received += len(data)
                target.sendall(data)
            target.shutdown(socket.SHUT_WR)
