"""Real servers under load: their processes, and the responses that clients received."""

import os
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from league.registry.processes import has_ended
from league.registry.registry import Registry
from league.registry.replicas import PROCESS
from league.settings import Storage
from serve_app.runtime.launch import DEPLOY_YAML

ACTION = "/v1/policies/board/action"


NO_SHEDDING = {"max_wait": 60.0}
"""Settings of a server that sheds no load: on a busy machine, a shed request would look like a failure."""


def deploy_file(folder: Path, settings: Mapping[str, Any]) -> Path:
    """Write a copy of deploy.yaml with other server settings."""
    document = yaml.safe_load(DEPLOY_YAML.read_text())
    document["applications"][0]["args"].update(settings)
    path = folder / "deploy.yaml"
    path.write_text(yaml.safe_dump(document))
    return path


def processes(storage: Storage, name: str) -> list[int]:
    """Processes of this name whose environment has the home of `storage`."""
    home = f"LEAGUE_HOME={storage.home}\0".encode()
    pids = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit() and int(entry.name) != os.getpid():
            with suppress(OSError):
                if home in (entry / "environ").read_bytes() and name.encode() in (entry / "cmdline").read_bytes():
                    pids.append(int(entry.name))
    return pids


def serving(registry: Registry, version: int) -> int:
    """The number of running replicas that report serving a version of `board`. A killed one stays registered."""
    running = {row.replica for row in registry.replicas.registered() if not has_ended(row.process[PROCESS])}
    return sum(row.version == version for row in registry.replicas.acknowledgements("board") if row.replica in running)


@dataclass(frozen=True)
class RayServer:
    """A running server and what it serves."""

    url: str
    grpc: str
    registry: Registry
    deploy: Path


@dataclass
class Load:
    """The responses that callers received."""

    versions: Counter[int] = field(default_factory=Counter)
    failures: list[str] = field(default_factory=list)


@contextmanager
def load(caller: Callable[[], Callable[[], int]], callers: int) -> Iterator[Load]:
    """Call without pause from several threads while the context lasts.

    Each thread calls `caller()` once; the function that it returns makes a request and returns the version that
    answered.
    """
    result, stop = Load(), threading.Event()

    def run() -> None:
        call = caller()
        while not stop.is_set():
            try:
                result.versions[call()] += 1
            except Exception as error:
                result.failures.append(repr(error))

    threads = [threading.Thread(target=run) for _ in range(callers)]
    for thread in threads:
        thread.start()
    try:
        yield result
    finally:
        stop.set()
        for thread in threads:
            thread.join()
