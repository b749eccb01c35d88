"""Load is shed when a queue stays too long, and a burst is not."""

import asyncio

import pytest

from league.errors import Overloaded
from serve_app.backlog import Backlog

pytestmark = pytest.mark.anyio
LIMIT, SHARE, PATIENCE = 3, 0.025, 0.1


class Loop:
    """A backlog whose turns are told how many requests they begin, and how long they take."""

    def __init__(self, limit: int = LIMIT) -> None:
        self.now = 1000.0
        self.backlog = Backlog(limit, SHARE, PATIENCE, lambda: self.now)

    async def turn(self, requests: int, seconds: float, each: float = 0.0) -> int:
        """How many of a turn's requests were let in. each: seconds that one of them takes, besides."""
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
        """Turns in which nobody comes."""
        for _ in range(3):
            await asyncio.sleep(0)


async def test_a_short_queue_is_never_cut() -> None:
    loop = Loop()
    assert [await loop.turn(LIMIT, 0.02) for _ in range(20)] == [LIMIT] * 20


async def test_one_request_at_a_time_is_no_queue_however_long_it_takes() -> None:
    loop = Loop()
    assert [await loop.turn(1, 1.0) for _ in range(20)] == [1] * 20


async def test_of_heavy_requests_a_turn_takes_few_and_of_light_ones_many() -> None:
    heavy, light = Loop(limit=1000), Loop(limit=1000)
    assert [await heavy.turn(64, 0.0, each=0.01) for _ in range(2)] == [64] * 2, "a burst"
    assert [await heavy.turn(64, 0.0, each=0.01) for _ in range(20)] == [3] * 20, "those begun within the share"
    assert [await light.turn(400, 0.0, each=0.00005) for _ in range(20)] == [400] * 20


async def test_a_turn_always_takes_one() -> None:
    loop = Loop()
    for _ in range(3):
        await loop.turn(10, 0.0, each=1.0)
    assert [await loop.turn(10, 0.0, each=1.0) for _ in range(5)] == [1] * 5


async def test_a_queue_that_stays_is_cut_after_patience_until_it_is_short_again() -> None:
    loop = Loop()
    assert [await loop.turn(10, 0.03) for _ in range(4)] == [10] * 4
    await loop.turn(10, 0.03)
    assert [await loop.turn(10, 0.03) for _ in range(20)] == [LIMIT] * 20
    assert await loop.turn(LIMIT, 0.02) == LIMIT
    assert await loop.turn(10, 0.03) == 10, "it begins anew"


async def test_bursts_that_come_now_and_then_are_not_cut() -> None:
    loop = Loop()
    for _ in range(20):
        assert await loop.turn(100, 0.05) == 100
        await loop.idle()


async def test_one_turn_that_takes_long_is_not_a_queue_that_stays() -> None:
    loop = Loop()
    assert await loop.turn(10, 5.0) == 10
    assert await loop.turn(10, 0.01) == 10


async def test_turns_that_take_longer_than_patience_are_cut_too() -> None:
    loop = Loop()
    assert [await loop.turn(10, 3 * PATIENCE) for _ in range(2)] == [10] * 2
    assert [await loop.turn(10, 3 * PATIENCE) for _ in range(20)] == [LIMIT] * 20
