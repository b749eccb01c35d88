"""Short forms of `benchmarks.hostile`, `benchmarks.one_caller` and `benchmarks.fuzz`.

Targets in seconds, and ratios of durations, depend on the speed of the machine: only the benchmarks compare them.
"""

from collections.abc import Callable, Iterator
from functools import partial

import pytest

from benchmarks import fuzz, hostile, one_caller
from benchmarks.harness import Target

pytestmark = pytest.mark.slow

CASES: dict[str, Callable[[], Iterator[Target]]] = {
    **{
        case: partial(hostile.main, [case], quick=True)
        for case in ("unauthenticated", "bodies", "confirmations", "locks")
    },
    **{attack: partial(one_caller.main, [attack], quick=True) for attack in ("grpc_messages", "websocket_pings")},
    "invalid requests": partial(fuzz.main, quick=True),
}


@pytest.mark.parametrize("case", CASES)
def test_the_server_withstands(case: str) -> None:
    targets = list(CASES[case]())
    assert targets
    assert [str(target) for target in targets if target.unit not in ("s", "×") and not target.met] == []
