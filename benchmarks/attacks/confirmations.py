"""Promotions that are awaited while one of three replicas is stuck, cut off from the database, or has a wrong clock."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import httpx

from benchmarks.harness import Target
from benchmarks.leagues.served_league import ACTION, BODY, promote
from benchmarks.registry.postgresql_replicas import StandaloneReplica, league_in_postgresql, standalone_replica
from league.errors import NotReady
from league.registry.registry import Registry
from league.registry.replicas import LIVENESS_TIMEOUT

WAIT = 0.5
"""Seconds that a promotion of a silent replica is awaited."""
HEALTHY_WAIT = 10.0
CLOCKS = (1.0, -1.0, 25.0)
"""Hours by which the clocks of three replicas are ahead."""
FORWARD = """
import socket, sys, threading
def pump(source, target):
    try:
        while data := source.recv(65536):
            target.sendall(data)
        target.shutdown(socket.SHUT_WR)
    except OSError:
        target.close()
listener = socket.create_server((sys.argv[2], 0))
print(listener.getsockname()[1], flush=True)
while True:
    client, _ = listener.accept()
    server = socket.socket(socket.AF_UNIX)
    server.connect(sys.argv[1])
    for pair in ((client, server), (server, client)):
        threading.Thread(target=pump, args=pair, daemon=True).start()
"""


def confirmations(count: int) -> Iterator[Target]:
    """The number of false confirmations, and of silent replicas that were not named."""
    with league_in_postgresql() as (registry, postgresql):
        yield from _silent(registry, postgresql, "stuck", count)
        yield from _silent(registry, postgresql, "cut off", count)
        yield from _wrong_clocks(registry, count)


def _silent(registry: Registry, postgresql: Path, case: str, count: int) -> Iterator[Target]:
    with ExitStack() as stack:
        port, forwarder = stack.enter_context(forwarding(postgresql / ".s.PGSQL.5432"))
        url = registry.storage.database_url.replace("@/", f"@127.0.0.1:{port}/").replace(f"host={postgresql}&", "")
        healthy = [stack.enter_context(standalone_replica(registry.storage, f"healthy-{n}")) for n in range(2)]
        silent = stack.enter_context(standalone_replica(registry.storage, "silent", database_url=url))
        _promote_everywhere(registry, [*healthy, silent], 2)
        halted = silent.process.pid if case == "stuck" else forwarder.pid
        os.kill(halted, signal.SIGSTOP)
        time.sleep(LIVENESS_TIMEOUT.total_seconds() + 2)
        false = unnamed = 0
        for number in range(count):
            event = promote(registry, 1 + number % 2)
            try:
                registry.changes.wait_for_alias(event, WAIT)
                false += 1
            except NotReady as error:
                unnamed += "silent has been silent for" not in str(error) or "healthy" in str(error)
        os.kill(halted, signal.SIGCONT)
        _promote_everywhere(registry, [*healthy, silent], 1 + count % 2)
    yield Target(f"replica {case}: false confirmations", false, at_most=0, note=f"of {count}")
    yield Target(f"replica {case}: not named", unnamed, at_most=0)


def _wrong_clocks(registry: Registry, count: int) -> Iterator[Target]:
    with ExitStack() as stack:
        replicas = [
            stack.enter_context(standalone_replica(registry.storage, f"clock{hours:+g}", hours)) for hours in CLOCKS
        ]
        false = missed = 0
        for number in range(count):
            event = promote(registry, 1 + number % 2)
            try:
                confirmed = registry.changes.wait_for_alias(event, HEALTHY_WAIT)
            except NotReady:
                missed += 1
                continue
            false += len(confirmed) < len(replicas) or any(_version(replica) != event.version for replica in replicas)
    yield Target("wrong clocks: false confirmations", false, at_most=0, note=f"of {count}")
    yield Target("wrong clocks: timeouts", missed, at_most=0)


def _promote_everywhere(registry: Registry, replicas: list[StandaloneReplica], version: int) -> None:
    registry.changes.wait_for_alias(promote(registry, version), 30)
    assert {_version(replica) for replica in replicas} == {version}


def _version(replica: StandaloneReplica) -> int:
    reply = httpx.post(replica.url + ACTION, content=BODY)
    return int(reply.json()["version"])


@contextmanager
def forwarding(path: Path, host: str = "127.0.0.1") -> Iterator[tuple[int, subprocess.Popen[str]]]:
    """A process that forwards a TCP port to a Unix socket; stopped, it acknowledges packets and answers nothing."""
    with subprocess.Popen(
        [sys.executable, "-c", FORWARD, str(path), host], stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        port = int(process.stdout.readline())
        try:
            yield port, process
        finally:
            process.kill()
