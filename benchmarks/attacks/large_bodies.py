"""The latency of normal requests while a key with a low rate limit sends the most expensive bodies."""

import subprocess
import sys
from pathlib import Path
from statistics import median

from benchmarks.leagues.served_league import BODY, LEAGUE
from benchmarks.load.http import JSON, Load, measure
from league.registry.registry import Registry

ROOT = Path(__file__).parents[2]
SLOWER = 2.0
"""Maximum ratio of the 99th percentiles."""
SIZE = 4 * 2**20 - 1024
RATE = 10.0
"""Requests per second that the attacker's key allows."""
NORMAL_RATE = 200.0
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


def large_bodies(url: str, registry: Registry, token: str, seconds: float, pairs: int) -> bool:
    """Print the ratios, by kind of body; whether all are within the limit. token: a key for the normal requests."""
    _, attacker = registry.keys.create("attacker", ["act"], rate=RATE)
    address = f"{url}/v1/policies/{LEAGUE}/action"
    headers = {**JSON, "x-api-key": token}

    def load() -> Load:
        return measure(address, BODY, connections=8, seconds=seconds, rate=NORMAL_RATE, headers=headers)

    load()
    met = True
    for kind, part in BODIES.items():
        ratios = []
        for _ in range(pairs):
            steady = load()
            with subprocess.Popen(_attack(address, attacker, part)) as attack:
                attacked = load()
                attack.kill()
            ratios.append(attacked.p99 / steady.p99)
            failed = attacked.failed + steady.failed
        ratio = median(ratios)
        print(f"4 MB of {kind}: p99 {steady.p99:.2f} ms → {attacked.p99:.2f} ms, {failed} failed; ", end="")
        print(f"median of {pairs}: {ratio:.2f}×   (at most {SLOWER:g}×)", flush=True)
        met &= ratio <= SLOWER and not failed
    return met


def _attack(address: str, token: str, part: bytes) -> list[str]:
    host, _, path = address.removeprefix("http://").partition("/")
    script = ATTACK.replace("SIZE", str(SIZE)).replace("RATE", str(RATE))
    return ["nice", sys.executable, "-c", script, host, f"/{path}", token, part.decode()]
