"""Timeouts that cost nothing for work that completes without waiting.

An asyncio timer costs several microseconds. Nearly all requests complete without suspending, so the work is started
first, and a timer is set only when it suspends.
"""

import asyncio
from collections.abc import Awaitable, Generator
from types import coroutine
from typing import Any, TypeVar

T = TypeVar("T")


class TimeLimitExceeded(Exception):
    """The work did not finish in time."""


async def run_within(seconds: float, work: Awaitable[T]) -> T:
    """Await `work` and return its result. Raises TimeLimitExceeded if it is still suspended after `seconds`."""
    steps = work.__await__()
    try:
        waits_for = steps.send(None)
    except StopIteration as end:
        result: T = end.value
        return result
    try:
        async with asyncio.timeout(seconds) as limit:
            return await resume(steps, waits_for)
    except TimeoutError as error:
        if limit.expired():
            raise TimeLimitExceeded from error
        raise


@coroutine
def resume(steps: Generator[Any, Any, T], waits_for: Any) -> Generator[Any, Any, T]:
    """Await the rest of a coroutine that was started by hand; equivalent to `await`."""
    while True:
        try:
            value = yield waits_for
        except BaseException as error:
            thrown: BaseException | None = error
        else:
            thrown = None
        try:
            waits_for = steps.send(value) if thrown is None else steps.throw(thrown)
        except StopIteration as end:
            result: T = end.value
            return result
