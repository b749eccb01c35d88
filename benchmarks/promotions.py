"""What does a promotion cost those who are being served, and how soon does it reach every replica?

200 times the champion moves between two versions, as `league promote` moves it, while 8 clients ask for actions without
a pause and without a second try. Counts the requests that failed, and those that were sent after every replica had
acknowledged a version and yet were answered by another; and the time from the promotion's return until every replica
has acknowledged it. Target: none failed, none wrong, at most a second.
"""

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import orjson
from numpy.typing import NDArray

from benchmarks.load import drive
from benchmarks.served_league import BODY, LEAGUE, publish
from league.registry.registry import Registry
from serve_app.launch import running

ROOT = Path(__file__).parent.parent
CLIENTS = 8
REPLICAS = 2
PROMISE = 1.0
"""Seconds from a promotion's return until every replica serves it."""


@dataclass(frozen=True, slots=True)
class Promotion:
    """One movement of the champion. Times by `time.perf_counter`, which all processes of a machine share."""

    version: int
    begun: float
    returned: float
    everywhere: float


def main() -> int:
    """Print what was counted; 1 if a target was missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--promotions", type=int, default=200)
    parser.add_argument("--quick", action="store_true", help="20 promotions: shows that it works, no more")
    parser.add_argument("--load", nargs=2, metavar=("URL", "FILE"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.load:
        _load(*options.load)
        return 0
    with tempfile.TemporaryDirectory() as scratch:
        registry = publish(Path(scratch) / "home", versions=2)
        replies = Path(scratch) / "replies.npy"
        with running(registry.storage, replicas=REPLICAS) as url:
            _await_replicas(registry, 1)
            with _loading(url, replies):
                promotions = [_promote(registry, 2 - i % 2) for i in range(20 if options.quick else options.promotions)]
        registry.close()
        return _report(promotions, np.load(replies))


def _report(promotions: list[Promotion], replies: NDArray) -> int:
    """replies: (n, 3), when it was sent, when it was answered, and by which version, 0 if not at all."""
    sent, answered, version = replies.T
    failed = int((version == 0).sum())
    wrong = sum(
        int(((sent > now.everywhere) & (answered < then.begun) & (version != now.version) & (version != 0)).sum())
        for now, then in pairwise(promotions)
    )
    reached = np.array([promotion.everywhere - promotion.returned for promotion in promotions])
    latencies = (answered - sent)[version != 0] * 1e3
    seconds = answered.max() - sent.min()
    print(f"{len(promotions)} promotions, {CLIENTS} clients, {REPLICAS} replicas: {len(replies):,} requests, ", end="")
    print(f"{len(replies) / seconds:,.0f}/s, p99 {np.percentile(latencies, 99):.1f} ms")
    print(f"failed requests: {failed}   (at most 0)")
    print(f"answered by a version that was replaced everywhere: {wrong}   (at most 0)")
    print(
        f"promotion → every replica: median {np.median(reached):.3f} s, p99 {np.percentile(reached, 99):.3f} s, "
        f"longest {reached.max():.3f} s   (at most {PROMISE:g} s)"
    )
    return int(failed + wrong > 0 or reached.max() > PROMISE)


def _promote(registry: Registry, version: int) -> Promotion:
    begun = time.perf_counter()
    expected = registry.aliases(LEAGUE)["champion"]
    registry.set_alias(LEAGUE, "champion", version, expected=expected, actor="benchmark", reason="back and forth")
    returned = time.perf_counter()
    _await_replicas(registry, version)
    return Promotion(version, begun, returned, time.perf_counter())


def _await_replicas(registry: Registry, version: int) -> None:
    """Return when every replica has acknowledged a version."""
    deadline = time.monotonic() + 30
    while sum(said.version == version for said in registry.acknowledgements(LEAGUE)) < REPLICAS:
        if time.monotonic() > deadline:
            raise TimeoutError(f"version {version} did not reach every replica within 30 s")
        time.sleep(0.005)


@contextmanager
def _loading(url: str, replies: Path) -> Iterator[None]:
    """Ask for actions in another process while the context lasts; the replies are in the file afterwards."""
    command = [sys.executable, "-m", "benchmarks.promotions", "--load", url, str(replies)]
    with subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as load:
        assert load.stdin is not None
        assert load.stdout is not None
        load.stdout.readline()  # the first reply
        try:
            yield
        finally:
            load.stdin.close()


def _load(url: str, file: str) -> None:
    """Ask until standard input ends."""
    import threading

    import uvloop

    stop = threading.Event()
    threading.Thread(target=lambda: (sys.stdin.read(), stop.set()), daemon=True).start()
    replies: list[tuple[float, float, int]] = []

    def on_reply(status: int, body: bytes, sent_at: float) -> bool:
        if not replies:
            print("answered", flush=True)
        replies.append((sent_at, time.perf_counter(), orjson.loads(body)["version"] if status == 200 else 0))
        return not stop.is_set()

    address = f"{url}/v1/policies/{LEAGUE}/action"
    uvloop.run(drive(address, BODY, CLIENTS, on_reply, lambda: not stop.is_set()))
    np.save(file, np.array(replies))


if __name__ == "__main__":
    sys.exit(main())
