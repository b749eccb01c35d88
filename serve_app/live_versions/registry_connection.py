"""A replica's connection to the registry's database, for all that it does without a request."""

import asyncio
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from typing import TypeVar

from league.registry.registry import Registry
from league.settings import Storage

SHUTDOWN_TIMEOUT = 5.0
"""Seconds to wait for the database during shutdown."""

T = TypeVar("T")


class RegistryConnection:
    """Queries the registry in a thread of its own, and waits for notifications on the event loop.

    A query that hangs delays no request. registry: opened with `listens`.
    """

    def __init__(self, registry: Registry) -> None:
        assert registry.database.listener is not None
        self.database = registry.database
        self._registry = registry
        self._listener = registry.database.listener
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="registry")
        self._is_notified = asyncio.Event()

    @property
    def storage(self) -> Storage:
        """Where the registry is."""
        return self._registry.storage

    @property
    def opened(self) -> int:
        """Number of connections so far."""
        return self._listener.opened

    def discard_notifications(self) -> None:
        """Discard the notifications that have arrived, before what they announce is read. Only in `call`."""
        self._listener.discard()

    async def call(self, function: Callable[[Registry], T]) -> T:
        """Query or change the registry."""
        loop = asyncio.get_running_loop()
        self._listener.on_change = partial(loop.call_soon_threadsafe, self._is_notified.set)
        return await loop.run_in_executor(self._thread, function, self._registry)

    async def wait(self, timeout: float) -> bool:
        """Wait for a notification, at most `timeout` seconds. Returns False at once if there are none.

        A notification that arrived since the last call counts.
        """
        # The thread may close the connection meanwhile, so this is a descriptor of our own.
        socket = self._listener.socket()
        if socket is None:
            return False
        loop = asyncio.get_running_loop()
        loop.add_reader(socket, self._is_notified.set)
        try:
            with suppress(TimeoutError):
                async with asyncio.timeout(timeout):
                    await self._is_notified.wait()
        finally:
            loop.remove_reader(socket)
            os.close(socket)
            self._is_notified.clear()
        return True

    def close(self) -> None:
        """Close the connection, after the query in progress."""
        self._thread.submit(self._registry.close)
        self._thread.shutdown(wait=False)
