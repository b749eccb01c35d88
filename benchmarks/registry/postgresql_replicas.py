"""The served league in a temporary PostgreSQL database, and replicas of it in processes of their own."""

import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from benchmarks.harness import ROOT
from benchmarks.leagues.served_league import fill
from league.registry.registry import Registry
from league.settings import Storage
from tests.support.servers import postgresql


@contextmanager
def league_in_postgresql(versions: int = 2) -> Iterator[tuple[Registry, Path]]:
    """A registry whose league has some versions, and the directory of the server's socket."""
    programs = postgresql.programs()
    if programs is None:
        sys.exit("PostgreSQL is not installed")
    with postgresql.server(programs) as socket, tempfile.TemporaryDirectory() as scratch:
        storage = Storage.at(Path(scratch) / "home")
        storage.home.mkdir(parents=True)
        registry = Registry.open(replace(storage, database_url=postgresql.create(socket, "hostile")))
        yield fill(registry, versions), socket
        registry.close()


@dataclass(frozen=True, slots=True)
class StandaloneReplica:
    """A replica in a process of its own. log: its standard error."""

    name: str
    process: subprocess.Popen[str]
    url: str
    log: Path


@contextmanager
def standalone_replica(
    storage: Storage, name: str, hours: float = 0.0, prefix: Sequence[str] = (), database_url: str | None = None
) -> Iterator[StandaloneReplica]:
    """Run a replica. hours: how far its clock is ahead. prefix: a command that runs it, such as `ip netns exec`."""
    log = storage.home / f"{name}.log"
    command = [*prefix, sys.executable, "-m", "benchmarks.registry.standalone_replica", name, str(storage.home)]
    command += [database_url or storage.database_url, str(storage.artifacts), f"--hours={hours}"]
    with (
        log.open("w") as errors,
        subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=errors, text=True) as process,
    ):
        assert process.stdout is not None
        port = process.stdout.readline().strip()
        if not port:
            sys.exit(f"replica {name} did not start: {log.read_text()[-2000:]}")
        try:
            yield StandaloneReplica(name, process, f"http://127.0.0.1:{port}", log)
        finally:
            process.kill()
