"""Time limits that cost nothing where nothing waits.

asyncio's timers cost several microseconds each. Nearly all requests are answered in one go, without once waiting, so a
request is begun first, and its timer is set only if it must wait.
"""

import asyncio
from collections.abc import Awaitable, Generator
from types import coroutine
from typing import Any, TypeVar

T = TypeVar("T")


class Expired(Exception):
    """What had to be done by then was not done."""


async def within(seconds: float, work: Awaitable[T]) -> T:
    """What `work` returns. Raises Expired if it has to wait for longer than that."""
    steps = work.__await__()
    try:
        waits_for = steps.send(None)
    except StopIteration as end:
        result: T = end.value
        return result
    try:
        async with asyncio.timeout(seconds) as limit:
            return await continued(steps, waits_for)
    except TimeoutError as error:
        if limit.expired():
            raise Expired from error
        raise


@coroutine
def continued(steps: Generator[Any, Any, T], waits_for: Any) -> Generator[Any, Any, T]:
    """The rest of what was begun by hand and waits: what `await` does."""
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
