"""Generated requests to two replicas of equal leagues, one with SQLite and one with PostgreSQL."""

import logging
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st

from benchmarks.harness import Target
from tests.support.generated_requests import OPERATIONS, draw_request
from tests.support.servers import postgresql
from tests.support.servers.two_databases import is_available, outline, replicas_of_both

EXAMPLES = 25
"""Of an operation at a time."""


def databases(requests: int) -> Iterator[Target]:
    """Send generated requests to both; prints the calls that differ or fail."""
    programs = postgresql.programs()
    if programs is None:
        sys.exit("PostgreSQL is not installed")
    logging.disable(logging.ERROR)
    statuses: Counter[int] = Counter()
    different: list[str] = []
    failed: list[str] = []
    with (
        postgresql.server(programs) as socket,
        tempfile.TemporaryDirectory() as scratch,
        replicas_of_both(Path(scratch), socket) as replicas,
    ):

        def send(data: Any, operation: Any) -> None:
            drawn = draw_request(data, operation)
            responses = replicas.responses(drawn.method, drawn.url, drawn.content, drawn.headers)
            one, other = map(outline, responses)
            statuses[one[0]] += 1
            call = f"{drawn.method} {drawn.url[:200]} {(drawn.content or b'')[:200]!r}"
            if one != other:
                different.append(f"{call}: {one[:2]} and {other[:2]}")
            if not is_available(*one[:2]):
                failed.append(f"{call}: {one[:2]}")

        for turn in count():
            for number, operation in enumerate(OPERATIONS):
                _generate(partial(send, operation=operation), EXAMPLES, turn * len(OPERATIONS) + number)
            if sum(statuses.values()) >= requests:
                break
    for line in (*different[:20], *failed[:20]):
        print(f"    {line}")
    sent = ", ".join(f"{count:,} × {status}" for status, count in sorted(statuses.items()))
    note = f"of {sum(statuses.values()):,}: {sent}"
    yield Target("SQLite and PostgreSQL: different responses", len(different), at_most=0, note=note)
    yield Target("SQLite and PostgreSQL: server errors", len(failed), at_most=0)


def _generate(use: Callable[[Any], None], examples: int, number: int) -> None:
    """Call `use` with sources of generated data."""

    @seed(number)
    @settings(
        max_examples=examples,
        deadline=None,
        database=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(data=st.data())
    def generate(data: Any) -> None:
        use(data)

    generate()
