"""The latency of normal requests while a key with a low rate limit sends the most expensive bodies."""

import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from statistics import median

from benchmarks.harness import Target
from benchmarks.leagues.served_league import ACTION, BODY
from benchmarks.load.http import JSON, Load, measure
from league.registry.registry import Registry

SLOWER = 2.0
"""Maximum ratio of the 99th percentiles."""
SIZE = 4 * 2**20 - 1024
RATE = 10.0
"""Requests per second that the attacker's key allows."""
NORMAL_RATE = 200.0
OVERLOADED = "429"
"""The status of requests that a replica refuses because it is busy, as it may on a machine that other programs use."""
BODIES = {
    "nested lists": b"[[1]],",
    "empty lists": b"[],",
    "numbers": b"1,",
    "objects": b"{},",
    "spaces": b" ",
}
ATTACK = """
import http.client, sys, time
host, path, token, part = sys.argv[1:]
part = part.encode()
body = b'{"observation": [' + part * ((int(SIZE) - 100) // len(part)) + b'1]}'
statuses = {}
while True:
    connection = http.client.HTTPConnection(host)
    due = time.monotonic() + 1 / float(RATE)
    try:
        connection.request("POST", path, body, {"x-api-key": token, "content-type": "application/json"})
        status = connection.getresponse().status
    except OSError:
        status = 0
    connection.close()
    time.sleep(max(0, due - time.monotonic()))
"""


def large_bodies(url: str, registry: Registry, token: str, seconds: float, pairs: int) -> Iterator[Target]:
    """The ratios, by kind of body. token: a key for the normal requests."""
    _, attacker = registry.keys.create("attacker", ["act"], rate=RATE)
    address = url + ACTION
    headers = {**JSON, "x-api-key": token}

    def load() -> Load:
        return measure(address, BODY, connections=8, seconds=seconds, rate=NORMAL_RATE, headers=headers)

    load()
    for kind, part in BODIES.items():
        ratios, statuses = [], Counter[str]()
        for _ in range(pairs):
            steady = load()
            with subprocess.Popen(_attack(address, attacker, part)) as attack:
                attacked = load()
                attack.kill()
            ratios.append(attacked.p99 / steady.p99)
            statuses.update(attacked.statuses)
        assert statuses.keys() <= {"200", OVERLOADED}, f"normal requests next to bodies of {kind}: {statuses}"
        note = f"p99 {steady.p99:.2f} to {attacked.p99:.2f} ms"
        yield Target(f"p99 beside 4 MB of {kind}", median(ratios), "×", at_most=SLOWER, peer="without", note=note)
        share = statuses[OVERLOADED] / statuses.total()
        yield Target(f"refused beside 4 MB of {kind}", share, "×", at_most=0, peer="all requests")


def _attack(address: str, token: str, part: bytes) -> list[str]:
    host, _, path = address.removeprefix("http://").partition("/")
    script = ATTACK.replace("SIZE", str(SIZE)).replace("RATE", str(RATE))
    return ["nice", sys.executable, "-c", script, host, f"/{path}", token, part.decode()]
