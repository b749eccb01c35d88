"""Promotions while callers request more numbered versions than a replica keeps in memory."""

import subprocess
import sys
import time

import numpy as np

from benchmarks.harness import Target
from benchmarks.leagues.served_league import ACTION, BODY, promote
from league.registry.registry import Registry

CALLERS = 200
TARGET = 0.5
"""Seconds from a promotion until all replicas serve it, 99th percentile."""
CALL = """
import asyncio, sys
from benchmarks.load.http import Connection, JSON, post

async def call(url, body, versions, callers, token):
    host, _, path = url.removeprefix("http://").partition("/")
    name, _, port = host.partition(":")
    loop = asyncio.get_running_loop()
    async def one(number):
        version = number
        while True:
            version = 1 + (version + callers) % versions
            request = post(f"{url}?version={version}", body, {**JSON, "x-api-key": token})
            try:
                _, connection = await loop.create_connection(
                    lambda: Connection(request, lambda *_: False), name, int(port))
                await connection.closed
            except OSError:
                await asyncio.sleep(0.05)
    await asyncio.gather(*(one(number) for number in range(callers)))

url, versions, callers, token = sys.argv[1:]
asyncio.run(call(url, sys.stdin.buffer.read(), int(versions), int(callers), token))
"""


def numbered_versions(url: str, registry: Registry, token: str, versions: int, promotions: int) -> Target:
    """The times of promotions to `versions` that callers request, too."""
    address = url + ACTION
    times = []
    with subprocess.Popen(
        ["nice", sys.executable, "-c", CALL, address, str(versions), str(CALLERS), token], stdin=subprocess.PIPE
    ) as callers:
        assert callers.stdin is not None
        callers.stdin.write(BODY)
        callers.stdin.close()
        time.sleep(3)
        for number in range(promotions):
            start = time.perf_counter()
            version = 1 + number * 7 % versions
            registry.changes.wait_for_alias(promote(registry, version), 30)
            times.append(time.perf_counter() - start)
        callers.kill()
    note = f"median {np.median(times):.3f} s, longest {max(times):.3f} s; {CALLERS} callers of {versions} versions"
    p99 = round(float(np.percentile(times, 99)), 3)
    return Target("promotion beside numbered versions, p99", p99, "s", at_most=TARGET, note=note)
