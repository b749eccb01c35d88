"""What changes in the registry, told to everybody who listens: one look for all of them, and none where nobody does.

A listener is told the newest state, not each on the way to it: who reads slowly misses steps, and holds up nobody.
"""

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from typing import Any

from league.errors import DeadlineExceeded, NotReady, Overloaded
from league.registry.registry import Registry
from serve_app.models import Models
from serve_app.polling import Polling
from serve_app.settings import ServeSettings

Document = dict[str, Any]
Look = Callable[[Registry], Document]

SILENCE = 2.0
"""Seconds after which a listener is told that nothing has changed. Less than half of
RAY_SERVE_HAPROXY_TIMEOUT_SERVER_S, after which HAProxy takes the replica for dead."""


class Subject:
    """Something that somebody listens to. Without a listener there is none."""

    __slots__ = ("changed", "document", "listeners", "look")

    def __init__(self, look: Look, document: Document) -> None:
        self.look = look
        self.document = document
        """What it was at the last look."""
        self.changed = asyncio.Event()
        """Set when it is something else; another one stands for the change after that."""
        self.listeners = 0

    def saw(self, document: Document) -> None:
        """Take what was seen, and wake those who wait for news."""
        if document != self.document:
            self.document = document
            self.wake()

    def wake(self) -> None:
        """Let all listeners go on."""
        self.changed.set()
        self.changed = asyncio.Event()


class Events:
    """What the listeners of a replica follow. All methods run on the event loop."""

    def __init__(self, models: Models, settings: ServeSettings) -> None:
        self._models = models
        self._settings = settings
        self._subjects: dict[str, Subject] = {}
        self._is_over = False
        self.open = 0
        """Listeners that there are."""
        slowest = max(settings.poll_events, settings.poll_slowest)
        pace = settings.model_copy(update={"poll": settings.poll_events, "poll_slowest": slowest})
        self._polling = Polling(self._look, "what is listened to", pace)

    @property
    def subjects(self) -> int:
        """How many different things are listened to."""
        return len(self._subjects)

    @asynccontextmanager
    async def watching(self) -> AsyncIterator[None]:
        """Tell what changes while the context lasts."""
        async with self._polling.running():
            try:
                yield
            finally:
                self.end()

    @asynccontextmanager
    async def listening(self, name: str, look: Look) -> AsyncIterator[AsyncIterator[Document | None]]:
        """Follow what `look` finds, which is the same for all that listen to `name`.

        Yields the state now and after each change; None where nothing has changed for SILENCE seconds.
        Raises Overloaded, NotReady, DeadlineExceeded or what `look` raises.
        """
        if self._is_over:
            raise NotReady("this replica stops: ask again, and another answers")
        if self.open >= self._settings.max_listeners:
            raise Overloaded(f"{self.open} listen here already")
        self.open += 1
        try:
            subject = self._subjects.get(name) or self._subjects.setdefault(name, await self._begun(look))
            subject.listeners += 1
            try:
                yield self._told(subject)
            finally:
                subject.listeners -= 1
                if not subject.listeners:
                    del self._subjects[name]
        finally:
            self.open -= 1

    def end(self) -> None:
        """Tell nobody anything more: the replica stops."""
        self._is_over = True
        for subject in self._subjects.values():
            subject.wake()

    async def _begun(self, look: Look) -> Subject:
        try:
            async with asyncio.timeout(self._settings.timeout):
                return Subject(look, await self._models.ask(look))
        except TimeoutError:
            raise DeadlineExceeded(f"this was not answered within {self._settings.timeout:g} s") from None

    async def _told(self, subject: Subject) -> AsyncIterator[Document | None]:
        document: Document | None = subject.document
        while not self._is_over:
            changed = subject.changed
            yield document
            with suppress(TimeoutError):
                async with asyncio.timeout(SILENCE):
                    await changed.wait()
            document = subject.document if changed.is_set() else None

    async def _look(self) -> None:
        """Look at everything that is listened to. Raises StorageError."""
        self._polling.saw()
        if subjects := list(self._subjects.values()):
            found = await self._models.ask(lambda registry: [subject.look(registry) for subject in subjects])
            for subject, document in zip(subjects, found, strict=True):
                subject.saw(document)
