"""Streams server-sent events: changes of a league or of an evaluation.

A stream starts with the current state. Listeners get the newest state, not every intermediate one, so slow readers
delay nobody. A stream ends when the replica stops, its key becomes invalid, or its state cannot be read any more, as
that of a removed league; clients reconnect, and get the error. Clients read it with `fetch`, because the `EventSource`
of browsers cannot send a key.
"""

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from datetime import datetime
from typing import Annotated, Any, Literal

import orjson
from pydantic import BeforeValidator, Field
from starlette import responses
from starlette.requests import Request
from starlette.types import ASGIApp, Receive, Scope, Send

from league.errors import DeadlineExceeded, NotFound, NotReady, StorageError, Unauthenticated, UnknownEvaluation
from league.registry.registry import Registry
from serve_app.access.access_control import KEY, AccessControl
from serve_app.access.api_keys import ApiKey
from serve_app.access.connection_limit import ConnectionLimit
from serve_app.declaration import EVENT_STREAM, Declaration, Response
from serve_app.live_versions.polling import Polling
from serve_app.live_versions.resolver import ModelResolver
from serve_app.routes.documents import Aliases, Evaluation, EvaluationProgress
from serve_app.runtime.ray_serve import logger
from serve_app.settings import ServeSettings

Document = dict[str, Any]
Query = Callable[[Registry], Document]

KEEPALIVE_INTERVAL = 2.0
"""Seconds between keep-alive comments. Less than half of RAY_SERVE_HAPROXY_TIMEOUT_SERVER_S, after which HAProxy
considers the replica dead."""


class Topic:
    """A state that listeners follow. It exists while it has listeners."""

    __slots__ = ("changed", "document", "has_ended", "listeners", "query")

    def __init__(self, query: Query, document: Document) -> None:
        self.query = query
        self.document = document
        """The state at the last poll."""
        self.changed = asyncio.Event()
        """Set at the next change, and then replaced."""
        self.listeners = 0
        self.has_ended = False
        """Whether the state cannot be read any more."""

    def end(self) -> None:
        """End the streams of all listeners."""
        self.has_ended = True
        self.wake()

    def update(self, document: Document) -> None:
        """Store the state, and notify listeners if it has changed."""
        if document != self.document:
            self.document = document
            self.wake()

    def wake(self) -> None:
        """Wake all listeners."""
        self.changed.set()
        self.changed = asyncio.Event()


class EventBroker:
    """The topics of a replica. All methods run on the event loop."""

    def __init__(self, models: ModelResolver, settings: ServeSettings) -> None:
        self._models = models
        self._settings = settings
        self._topics: dict[str, Topic] = {}
        self._is_over = False
        self.connections = ConnectionLimit("event streams", settings.max_listeners, settings.max_listeners_per_key)
        self._polling = Polling(self._poll, "event streams", settings.poll_events, settings.poll_slowest)

    @property
    def topics(self) -> int:
        """Number of topics."""
        return len(self._topics)

    @asynccontextmanager
    async def watching(self) -> AsyncIterator[None]:
        """Poll for changes while the context is active."""
        async with self._polling.running():
            try:
                yield
            finally:
                self.end()

    @asynccontextmanager
    async def subscribe(
        self, name: str, query: Query, key: ApiKey | None = None
    ) -> AsyncIterator[AsyncIterator[Document | None]]:
        """Follow the result of `query`, which is the same for all listeners of `name`.

        Yields the current state and each change; None if nothing has changed for KEEPALIVE_INTERVAL seconds. Raises
        Overloaded, NotReady, DeadlineExceeded or the errors of `query`.
        """
        if self._is_over:
            raise NotReady("this replica is shutting down: reconnect")
        with self.connections.opened(key):
            topic = self._topics.get(name)
            if topic is None:
                try:
                    async with asyncio.timeout(self._settings.timeout):
                        document = await self._models.in_registry_thread(query)
                except TimeoutError:
                    raise DeadlineExceeded(f"the request timed out after {self._settings.timeout:g} s") from None
                topic = self._topics.setdefault(name, Topic(query, document))
            topic.listeners += 1
            try:
                yield self._updates(topic)
            finally:
                topic.listeners -= 1
                if not topic.listeners and self._topics.get(name) is topic:
                    del self._topics[name]

    def end(self) -> None:
        """End all streams: the replica stops."""
        self._is_over = True
        for topic in self._topics.values():
            topic.wake()

    async def _updates(self, topic: Topic) -> AsyncIterator[Document | None]:
        document: Document | None = topic.document
        while not (self._is_over or topic.has_ended):
            changed = topic.changed
            yield document
            with suppress(TimeoutError):
                async with asyncio.timeout(KEEPALIVE_INTERVAL):
                    await changed.wait()
            document = topic.document if changed.is_set() else None

    async def _poll(self) -> None:
        """Query all topics. One whose state cannot be read ends. Raises StorageError."""
        self._polling.mark_ready()
        topics = dict(self._topics)
        if not topics:
            return
        states = await self._models.in_registry_thread(
            lambda registry: [_state(topic, registry) for topic in topics.values()]
        )
        for (name, topic), state in zip(topics.items(), states, strict=True):
            if isinstance(state, Exception):
                if not isinstance(state, NotFound):
                    logger.error("the event streams of %s end", name, exc_info=state)
                if self._topics.get(name) is topic:
                    del self._topics[name]  # the next listener gets the error
                topic.end()
            else:
                topic.update(state)


def _state(topic: Topic, registry: Registry) -> Document | Exception:
    """The state of a topic, or why it cannot be read. Raises StorageError if the database cannot be used at all."""
    try:
        return topic.query(registry)
    except StorageError:
        raise
    except Exception as error:
        return error


HEADERS = {"cache-control": "no-store", "x-accel-buffering": "no"}
"""The second disables buffering in nginx."""
KEEPALIVE = b": keep-alive\n\n"


class RunningEvaluation(Response):
    """A queued or running evaluation."""

    evaluation: int = Field(validation_alias="id")
    state: Literal["queued", "running"]
    progress: EvaluationProgress | None


class CurrentRun(Response):
    """A training run that has not ended."""

    run: str = Field(validation_alias="id")
    state: Literal["running", "silent"]
    steps: int


class LeagueState(Response):
    """The data of a `league` event. At least one field differs from the previous event."""

    league: str
    aliases: Aliases
    event: int | None = Field(description="The newest change of an alias.")
    version: int | None = Field(description="The newest version.")
    note: int | None = Field(description="The newest note of a version.")
    traffic: int | None = Field(description="The current setting of canary and shadow.")
    serving: dict[Annotated[str, BeforeValidator(str)], int] = Field(
        description="Number of replicas by the version that they serve as champion."
    )
    verdicts: dict[str, int] = Field(description="Number of verdicts by outcome, or `open`.")
    evaluation: int | None = Field(description="The newest evaluation.")
    evaluations: list[RunningEvaluation] = Field(description="Queued and running evaluations.")
    run: str | None = Field(description="The newest training run.")
    runs: list[CurrentRun] = Field(description="Training runs that have not ended.")
    computed_at: datetime | None = Field(description="When the leaderboard, ratings or verdicts were last computed.")


class EventRoutes:
    """The endpoints."""

    def __init__(self, events: EventBroker, access: AccessControl) -> None:
        self._events = events
        self._access = access

    @Declaration(
        "GET",
        "/v1/leagues/{league}/events",
        LeagueState,
        scope="read",
        tag="Read",
        success="A stream of events.",
        media=EVENT_STREAM,
    )
    async def league_events(self, request: Request, league: str) -> ASGIApp:
        """Follow the changes of a league.

        Server-sent events named `league` whose data is a `LeagueState` in JSON: one immediately, and one after each
        change. A field that differs from the previous event shows which resources to reload. Rapid changes may be
        combined into one event.

        A comment is sent every 2 s. The stream ends when the replica stops or the key is no longer valid: open it
        again. Read it with `fetch`; `EventSource` cannot send an API key.
        """

        def query(registry: Registry) -> Document:
            return LeagueState.model_validate(registry.changes.token(league)).model_dump()

        return self._stream(request, "league", query, is_last=lambda _: False)

    @Declaration(
        "GET",
        "/v1/leagues/{league}/evaluations/{evaluation}/events",
        Evaluation,
        scope="read",
        tag="Evaluation",
        success="A stream of events.",
        media=EVENT_STREAM,
        errors=(UnknownEvaluation,),
    )
    async def evaluation_events(self, request: Request, league: str, evaluation: int) -> ASGIApp:
        """Follow an evaluation.

        Server-sent events named `evaluation` whose data is the response of `GET …/evaluations/{evaluation}`: one
        immediately, and one after each change. The stream ends with the evaluation, or earlier for the same reasons as
        the stream of a league.
        """

        def query(registry: Registry) -> Document:
            return Evaluation.model_validate(registry.evaluations.get(league, evaluation)).model_dump()

        return self._stream(request, "evaluation", query, is_last=lambda document: document["ended_at"] is not None)

    def _stream(
        self, request: Request, kind: str, query: Callable[[Registry], Document], is_last: Callable[[Document], bool]
    ) -> ASGIApp:
        if request.method == "HEAD":
            return responses.Response(headers=HEADERS, media_type=EVENT_STREAM[0])

        def encodable(registry: Registry) -> Document:
            """The document, if it is one that can be sent: later, the response has begun."""
            orjson.dumps(document := query(registry))
            return document

        async def stream(scope: Scope, receive: Receive, send: Send) -> None:
            async with self._events.subscribe(scope["path"], encodable, scope.get(KEY)) as states:
                messages = _messages(states, kind, is_last, lambda: self._access.check_key(scope.get(KEY)))
                await responses.StreamingResponse(messages, headers=HEADERS, media_type=EVENT_STREAM[0])(
                    scope, receive, send
                )

        return stream


async def _messages(
    states: AsyncIterator[Document | None],
    kind: str,
    is_last: Callable[[Document], bool],
    check: Callable[[], None],
) -> AsyncIterator[bytes]:
    """A stream of events of one kind (HTML Standard, section 9.2.5), until `check` raises Unauthenticated."""
    async for document in states:
        try:
            check()
        except Unauthenticated:
            return
        if document is None:
            yield KEEPALIVE
            continue
        yield b"event: %b\ndata: %b\n\n" % (kind.encode(), orjson.dumps(document))
        if is_last(document):
            return
