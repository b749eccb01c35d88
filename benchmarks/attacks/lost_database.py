"""A replica whose connection to PostgreSQL drops all packets for a while, in a network namespace of its own."""

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from datetime import datetime

from benchmarks.attacks.confirmations import forwarding
from benchmarks.harness import Target
from benchmarks.leagues.served_league import ACTION, BODY
from benchmarks.registry.postgresql_replicas import StandaloneReplica, league_in_postgresql, standalone_replica
from league.registry.registry import Registry

NAMESPACE, HERE, THERE = f"league-{os.getpid()}", "10.213.7.1", "10.213.7.2"
NOTICED, USED = 10.0, 5.0
"""Limits in seconds: until the loss is logged, and until the restored connection is used."""
CALL = """
import json, sys, time, urllib.request
url, body, count, failed = sys.argv[1], sys.stdin.buffer.read(), 0, 0
end = time.monotonic() + float(sys.argv[2])
while time.monotonic() < end:
    request = urllib.request.Request(url, body, {"content-type": "application/json"})
    try:
        with urllib.request.urlopen(request, timeout=5) as reply:
            json.load(reply)
    except OSError:
        failed += 1
    count += 1
    time.sleep(0.005)
print(count, failed)
"""


def lost_database(seconds: float, rounds: int) -> Iterator[Target]:
    """The times until the loss is noticed and the connection is used again, and lost actions. Requires root."""
    if os.geteuid() or not shutil.which("ip"):
        sys.exit("the loss of the database requires root and the command `ip`")
    with league_in_postgresql() as (registry, socket), ExitStack() as stack:
        link = stack.enter_context(_namespace())
        port, _ = stack.enter_context(forwarding(socket / ".s.PGSQL.5432", HERE))
        url = registry.storage.database_url.replace("@/", f"@{HERE}:{port}/").replace(f"host={socket}&", "")
        replica = stack.enter_context(
            standalone_replica(registry.storage, "remote", prefix=_inside(), database_url=url)
        )
        results = [_round(registry, replica, link, seconds) for _ in range(rounds)]
    noticed, used, failed, counts = zip(*results, strict=True)
    yield Target("dropped packets to PostgreSQL: noticed", noticed, "s", at_most=NOTICED)
    yield Target("restored connection to PostgreSQL: used", used, "s", at_most=USED)
    yield Target("dropped packets to PostgreSQL: actions lost", sum(failed), at_most=0, note=f"of {sum(counts):,}")


def _round(registry: Registry, replica: StandaloneReplica, link: str, seconds: float) -> tuple[float, float, int, int]:
    """Seconds until the loss is noticed, and until the connection is used again; failed calls, and all calls."""
    address, logged = replica.url + ACTION, replica.log.stat().st_size
    command = [*_inside(), sys.executable, "-c", CALL, address, str(seconds + 10)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as calls:
        assert calls.stdin is not None
        calls.stdin.write(BODY)
        calls.stdin.close()
        calls.stdin = None
        time.sleep(2)
        _ip("link", "set", link, "down")
        cut, noticed = time.monotonic(), float("inf")
        while time.monotonic() - cut < seconds:
            if noticed == float("inf") and "cannot poll the registry" in replica.log.read_text()[logged:]:
                noticed = time.monotonic() - cut
            time.sleep(0.05)
        last = _seen(registry, replica)
        _ip("link", "set", link, "up")
        restored = time.monotonic()
        while _seen(registry, replica) == last and time.monotonic() - restored < 60:
            time.sleep(0.05)
        used = time.monotonic() - restored
        output, _ = calls.communicate()
    count, failed = map(int, output.split())
    return round(noticed, 1), round(used, 1), failed, count


def _seen(registry: Registry, replica: StandaloneReplica) -> datetime | None:
    return next((row.seen_at for row in registry.replicas.registered() if row.replica == replica.name), None)


def _inside() -> list[str]:
    return ["ip", "netns", "exec", NAMESPACE]


def _ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True)


@contextmanager
def _namespace() -> Iterator[str]:
    """A network namespace that reaches this one; yields the link that connects them, on this side."""
    near_end, far_end = f"h{os.getpid()}", f"t{os.getpid()}"
    _ip("netns", "add", NAMESPACE)
    try:
        _ip("link", "add", near_end, "type", "veth", "peer", "name", far_end, "netns", NAMESPACE)
        _ip("addr", "add", f"{HERE}/30", "dev", near_end)
        _ip("link", "set", near_end, "up")
        for arguments in (
            ("addr", "add", f"{THERE}/30", "dev", far_end),
            ("link", "set", far_end, "up"),
            ("link", "set", "lo", "up"),
        ):
            _ip("-n", NAMESPACE, *arguments)
        yield near_end
    finally:
        with suppress(subprocess.CalledProcessError):
            _ip("netns", "del", NAMESPACE)
