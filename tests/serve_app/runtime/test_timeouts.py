"""Work that waits too long is cancelled; work that does not wait is not affected."""

import asyncio

import pytest

from serve_app.runtime.timeouts import TimeLimitExceeded, run_within

pytestmark = pytest.mark.anyio
LONG = 60.0


async def test_work_that_does_not_wait_completes_without_time() -> None:
    async def work() -> int:
        return 5

    assert await run_within(0, work()) == 5


async def test_waiting_work_gets_results_and_errors() -> None:
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
    assert await run_within(LONG, work(good)) == 42
    assert await run_within(LONG, work(bad)) == 0


async def test_errors_are_passed_on() -> None:
    async def work(waits: bool) -> None:
        if waits:
            await asyncio.sleep(0)
        raise TimeoutError("its own")

    for waits in (False, True):
        with pytest.raises(TimeoutError, match="its own"):
            await run_within(LONG, work(waits))


async def test_work_that_waits_too_long_is_cancelled_and_can_clean_up() -> None:
    cleaned_up = []

    async def work() -> None:
        try:
            await asyncio.Event().wait()
        finally:
            await asyncio.sleep(0)
            cleaned_up.append(True)

    with pytest.raises(TimeLimitExceeded):
        await run_within(0.01, work())
    assert cleaned_up


async def test_a_cancelled_caller_cancels_the_work() -> None:
    cancelled = asyncio.Event()

    async def work() -> None:
        try:
            await asyncio.Event().wait()
        except asyncio.CancelledError:
            cancelled.set()
            raise

    task = asyncio.create_task(run_within(LONG, work()))
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert cancelled.is_set()
