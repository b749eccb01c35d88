"""Load is shed if a queue persists, but not in a burst."""

import asyncio

import pytest

from league.errors import Overloaded
from serve_app.access.load_shedding import Backlog

pytestmark = pytest.mark.anyio
LIMIT, SHARE, PATIENCE = 3, 0.025, 0.1


class Loop:
    """A backlog with a controlled number and duration of requests in each turn of the event loop."""

    def __init__(self, limit: int = LIMIT) -> None:
        self.now = 1000.0
        self.backlog = Backlog(limit, SHARE, PATIENCE, lambda: self.now)

    async def turn(self, requests: int, seconds: float, each: float = 0.0) -> int:
        """The number of requests admitted in a turn. each: additional seconds of each admitted request."""
        admitted = 0
        for _ in range(requests):
            try:
                self.backlog.admit()
            except Overloaded:
                continue
            admitted += 1
            self.now += each
        self.now += seconds
        await asyncio.sleep(0)
        return admitted

    async def idle(self) -> None:
        """Turns without requests."""
        for _ in range(3):
            await asyncio.sleep(0)


async def test_a_short_queue_is_never_shed() -> None:
    loop = Loop()
    assert [await loop.turn(LIMIT, 0.02) for _ in range(20)] == [LIMIT] * 20


async def test_single_requests_are_not_a_queue_however_long_they_take() -> None:
    loop = Loop()
    assert [await loop.turn(1, 1.0) for _ in range(20)] == [1] * 20
    assert await loop.turn(2, 0.0, each=2 * SHARE) == 2, "no queue has built up"


async def test_the_number_of_requests_in_a_turn_depends_on_their_duration() -> None:
    heavy, light = Loop(limit=1000), Loop(limit=1000)
    assert [await heavy.turn(64, 0.0, each=0.01) for _ in range(2)] == [64] * 2, "a burst"
    assert [await heavy.turn(64, 0.0, each=0.01) for _ in range(20)] == [3] * 20, "requests started within the share"
    assert [await light.turn(400, 0.0, each=0.00005) for _ in range(20)] == [400] * 20


async def test_a_turn_always_admits_one_request() -> None:
    loop = Loop()
    for _ in range(3):
        await loop.turn(10, 0.0, each=1.0)
    assert [await loop.turn(10, 0.0, each=1.0) for _ in range(5)] == [1] * 5


async def test_a_persistent_queue_is_shed_until_it_is_short() -> None:
    loop = Loop()
    assert [await loop.turn(10, 0.03) for _ in range(4)] == [10] * 4
    await loop.turn(10, 0.03)
    assert [await loop.turn(10, 0.03) for _ in range(20)] == [LIMIT] * 20
    assert await loop.turn(LIMIT, 0.02) == LIMIT
    assert await loop.turn(10, 0.03) == 10, "the time starts again"


async def test_requests_of_earlier_turns_take_places_until_they_are_answered() -> None:
    loop = Loop(limit=10)
    loop.backlog.queued = 8
    assert [await loop.turn(2, 0.02) for _ in range(20)] == [2] * 20
    for _ in range(10):
        await loop.turn(5, 0.02)
    assert [await loop.turn(5, 0.02) for _ in range(20)] == [2] * 20
    await loop.idle()
    assert await loop.turn(5, 0.02) == 2, "it is not empty yet"
    loop.backlog.queued = 0
    await loop.idle()
    assert await loop.turn(20, 0.02) == 20, "the time starts again"


async def test_occasional_bursts_are_not_shed() -> None:
    loop = Loop()
    for _ in range(20):
        assert await loop.turn(100, 0.05) == 100
        await loop.idle()


async def test_one_long_turn_is_not_a_persistent_queue() -> None:
    loop = Loop()
    assert await loop.turn(10, 5.0) == 10
    assert await loop.turn(10, 0.01) == 10


async def test_turns_longer_than_the_tolerance_are_shed() -> None:
    loop = Loop()
    assert [await loop.turn(10, 3 * PATIENCE) for _ in range(2)] == [10] * 2
    assert [await loop.turn(10, 3 * PATIENCE) for _ in range(20)] == [LIMIT] * 20
