"""Calls of the search service: they share messages, and nothing is searched for which nobody waits."""

import asyncio
from collections.abc import Awaitable
from typing import Any

import pytest

from league.errors import GraphTimeout
from serve_app.live_versions.remote_search import MESSAGES, CallQueue, SearchClient

pytestmark = pytest.mark.anyio


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


class HeldService:
    """Stands for the handle: answers each message with its calls, once `released` is set."""

    def __init__(self) -> None:
        self.released = asyncio.Event()
        self.messages: list[list[tuple[object, ...]]] = []
        self.ended = 0

    @property
    def searches(self) -> "HeldService":
        return self

    def remote(self, calls: list[tuple[object, ...]]) -> Awaitable[list[dict[str, Any]]]:
        """A message."""
        self.messages.append(calls)
        return self._answer(calls)

    async def _answer(self, calls: list[tuple[object, ...]]) -> list[dict[str, Any]]:
        try:
            await self.released.wait()
        except asyncio.CancelledError:
            self.ended += 1
            raise
        return [{"call": call[0]} for call in calls]


@pytest.mark.parametrize("processes", [1, 3])
async def test_calls_that_wait_are_divided_among_the_messages(processes: int) -> None:
    service = HeldService()
    client, queue = SearchClient(service, processes), CallQueue()  # type: ignore[arg-type]
    async with client.running():
        calls = [asyncio.wrap_future(client.search(queue, lambda i=i: (i,), 60.0)) for i in range(20)]  # type: ignore[misc]
        await until_sent(service, MESSAGES * processes)
        service.released.set()
        assert [response["call"] for response in await asyncio.gather(*calls)] == list(range(20))
    assert sorted(call[0] for calls in service.messages for call in calls) == list(range(20))
    assert MESSAGES * processes < len(service.messages) < 20


async def test_abandoned_calls_are_not_sent_and_their_message_ends() -> None:
    service = HeldService()
    client, queue = SearchClient(service, 1), CallQueue()  # type: ignore[arg-type]
    async with client.running():
        sent = [asyncio.wrap_future(client.search(queue, lambda: ("sent",), 60.0)) for _ in range(MESSAGES)]
        await until_sent(service, MESSAGES)
        with pytest.raises(GraphTimeout, match=r"did not respond within 0\.01 s"):
            await asyncio.wrap_future(client.search(queue, lambda: ("late",), 0.01))
        sent[0].cancel()
        while not service.ended:
            await asyncio.sleep(0)
        service.released.set()
        assert (await sent[1])["call"] == "sent"
        assert await asyncio.wrap_future(client.search(queue, lambda: ("next",), 60.0)) == {"call": "next"}
    assert [calls for calls in service.messages if ("late",) in calls] == []


async def until_sent(service: HeldService, number: int) -> None:
    while len(service.messages) < number:
        await asyncio.sleep(0)
