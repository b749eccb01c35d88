"""What waits for too long is ended; what does not wait is not touched."""

import asyncio

import pytest

from serve_app.deadlines import Expired, within

pytestmark = pytest.mark.anyio
LONG = 60.0


async def test_what_is_done_at_once_is_done_however_little_time_there_is() -> None:
    async def work() -> int:
        return 5

    assert await within(0, work()) == 5


async def test_what_waits_gets_its_values_and_its_errors() -> None:
    async def work(future: asyncio.Future[int]) -> int:
        await asyncio.sleep(0)
        try:
            found = await future
        except ZeroDivisionError:
            found = -1
        return found + await asyncio.to_thread(lambda: 1)

    loop = asyncio.get_running_loop()
    good, bad = loop.create_future(), loop.create_future()
    loop.call_later(0.01, good.set_result, 41)
    loop.call_later(0.01, bad.set_exception, ZeroDivisionError())
    assert await within(LONG, work(good)) == 42
    assert await within(LONG, work(bad)) == 0


async def test_errors_pass_through() -> None:
    async def work(waits: bool) -> None:
        if waits:
            await asyncio.sleep(0)
        raise TimeoutError("its own")

    for waits in (False, True):
        with pytest.raises(TimeoutError, match="its own"):
            await within(LONG, work(waits))


async def test_what_waits_for_too_long_is_ended_and_may_clear_up() -> None:
    cleared = []

    async def work() -> None:
        try:
            await asyncio.Event().wait()
        finally:
            await asyncio.sleep(0)
            cleared.append(True)

    with pytest.raises(Expired):
        await within(0.01, work())
    assert cleared


async def test_a_cancelled_caller_cancels_what_it_waits_for() -> None:
    cancelled = asyncio.Event()

    async def work() -> None:
        try:
            await asyncio.Event().wait()
        except asyncio.CancelledError:
            cancelled.set()
            raise

    task = asyncio.create_task(within(LONG, work()))
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert cancelled.is_set()
