"""How does a replica handle 10,000 invalid request bodies?

The bodies of `benchmarks.attacks.invalid_requests`. No response is a 5xx, no connection is dropped, the same process
answers at the end, and its memory has grown by at most 5 % since the first tenth.
"""

from collections.abc import Iterator

from benchmarks.attacks.invalid_requests import invalid_requests
from benchmarks.harness import Quick, Target
from benchmarks.leagues.served_league import served


def main(quick: Quick = False, bodies: int = 10_000, seed: int = 0) -> Iterator[Target]:
    """Send all bodies to one replica."""
    with served(2, replicas=1) as (url, registry):
        yield from invalid_requests(url, registry.storage.home, 500 if quick else bodies, seed)
