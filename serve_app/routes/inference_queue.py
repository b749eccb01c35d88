"""The fast path of inference over HTTP: requests that arrive with their body are answered without a task and an ASGI
application.

The connection hands over a request instead of starting a task for it. All requests of one turn of the event loop are
started one after the other, and wait for their runs, which are done as one batch per policy and format (see
`Batches`). A request that waits for something else, such as a version that is not in memory or a run in a thread,
continues in the application. So do those that never come here: large bodies, and unusual headers. A request is admitted
once, here or by the middleware.

Requests that arrive faster than they are answered wait in a queue, the oldest first. It has as many as are answered
soon (see `Backlog`), with bodies of at most LARGE_BODY bytes that are not parsed yet. A turn ends after SLICE seconds,
so that new requests are accepted or refused soon.
"""

from asyncio import AbstractEventLoop
from collections import deque
from collections.abc import Coroutine
from functools import lru_cache, partial
from time import monotonic, perf_counter_ns
from typing import Any, NamedTuple, cast

from starlette.types import Scope

from league.errors import LeagueError
from league.refs import CHAMPION
from serve_app.access.access_control import ADMISSION, KEY_HEADER, Admission
from serve_app.access.errors import ErrorHandlers
from serve_app.codecs.request_limits import LARGE_BODY
from serve_app.inference.batches import GraphRun
from serve_app.inference.http_route import REPLICA, STARTED, HttpRoute, Reply
from serve_app.routes.action import PATH_PREFIX, PATH_SUFFIX
from serve_app.runtime.uvicorn_http import HttpProtocol, header_lines

NOT_PLAIN = frozenset((b"content-encoding", b"expect", b"transfer-encoding", b"x-request-timeout-ms"))
"""Headers of requests for the application."""
SLICE = 0.005
"""Seconds after which a turn answers no further group of requests."""
GROUP = 32
"""Requests that are parsed and answered together."""
MAX_CACHED = 256
"""Length of the longest URL whose target is cached: callers can send any."""
MODELS = "/v2/models/"
"""Prefix of the paths of the Open Inference Protocol."""
Steps = Coroutine[Any, Any, Reply]


END = b"\r\n"
END_WITH_KEY = header_lines((KEY_HEADER,)) + END


class Target(NamedTuple):
    """What the URL of a request names. path: below the root path. version: a number or an alias."""

    path: str
    model: str
    version: str
    is_action: bool
    """Whether it is the action route; otherwise the Open Inference Protocol."""


class InferenceQueue:
    """The requests of all connections of a replica that wait to be answered. See `PlainRequests`."""

    def __init__(self, action: HttpRoute, infer: HttpRoute, errors: ErrorHandlers, replica: str) -> None:
        self._serving = action.serving
        self._action = action
        self._infer = infer
        self._root_path = self._serving.settings.root_path
        # The application adds the headers for pages of other origins.
        self._not_plain = NOT_PLAIN | ({b"origin"} if self._serving.settings.cors_origins else set())
        self._errors = errors
        self._replica = header_lines(((REPLICA, replica.encode()),))
        self._arrived: list[HttpProtocol] = []
        """Connections whose request was not admitted yet."""
        self._queue: deque[tuple[int, HttpProtocol]] = deque()
        """Those whose request was, and when: nanoseconds of `perf_counter_ns`."""
        self._has_turn = False
        self._turn_began = 0.0
        """When the last turn ended, or the first request arrived after it: other work of the event loop counts, too."""

    def takes(self, url: bytes, headers: list[tuple[bytes, bytes]]) -> bool:
        """See `PlainRequests.takes`."""
        target = _target(url, self._root_path)
        if target is None:
            return False
        size = LARGE_BODY + 1
        for name, value in headers:
            if name == b"content-length":
                size = int(value)
            elif name in self._not_plain or (
                name == b"content-type" and target.is_action and value != b"application/json"
            ):
                return False
        return size <= LARGE_BODY

    def add(self, connection: HttpProtocol) -> None:
        """See `PlainRequests.add`."""
        self._arrived.append(connection)
        if not self._has_turn:
            self._has_turn, self._turn_began = True, monotonic()
            connection.loop.call_soon(self._take_turn, connection.loop)

    def _take_turn(self, loop: AbstractEventLoop) -> None:
        begin, answered = monotonic(), 0
        try:
            self._admit()
            while self._queue and (not answered or monotonic() < begin + SLICE):
                answered += min(GROUP, len(self._queue))
                self._answer_group()
        finally:  # whatever happens to one connection
            if answered:
                began, self._turn_began = self._turn_began, monotonic()
                self._serving.access.backlog.count_answered(answered, self._turn_began - began)
            self._has_turn = bool(self._queue)
            if self._has_turn:
                loop.call_soon(self._take_turn, loop)

    def flush(self) -> None:
        """See `PlainRequests.flush`."""
        self._admit()
        while self._queue:
            self._answer_group()

    def _admit(self) -> None:
        arrived, self._arrived, time = self._arrived, [], perf_counter_ns()
        for connection in arrived:
            scope = cast(Scope, connection.scope)
            try:
                scope[ADMISSION] = self._serving.access.admission(scope, self._target(connection).path)
            except Exception as error:
                self._refuse(connection, error)
            else:
                self._queue.append((time, connection))
                self._serving.access.backlog.queued += 1

    def _answer_group(self) -> None:
        for _ in range(min(GROUP, len(self._queue))):
            time, connection = self._queue.popleft()
            self._serving.access.backlog.queued -= 1
            target, headers = self._target(connection), cast(Scope, connection.scope)["headers"]
            route = self._action if target.is_action else self._infer
            try:
                self._serving.check_in_flight(route.api)
            except LeagueError as error:
                self._refuse(connection, error)
            else:
                answer = route.answer(target.model, target.version, headers, connection.body, time)
                self._advance(connection, answer, None)
        self._serving.batches.flush()

    def _advance(self, connection: HttpProtocol, steps: Steps, outcome: Any) -> None:
        """Continue a request with the value or the exception that it awaits."""
        try:
            waits_for = steps.throw(outcome) if isinstance(outcome, Exception) else steps.send(outcome)
        except StopIteration as done:
            reply: Reply = done.value
            length = b"content-length: %d\r\n" % len(reply.body)
            self._reply(connection, 200, header_lines(reply.headers) + length + self._replica, reply.body)
        except Exception as error:
            self._refuse(connection, error)
        else:
            if isinstance(waits_for, GraphRun):
                waits_for.later(connection.loop, partial(self._advance, connection, steps))
            else:
                cast(Scope, connection.scope)[STARTED] = steps, waits_for
                connection.pass_on()

    def _refuse(self, connection: HttpProtocol, error: Exception) -> None:
        path = self._target(connection).path
        response = self._errors.response(path, error)
        self._reply(connection, response.status_code, header_lines(tuple(response.raw_headers)), bytes(response.body))

    def _reply(self, connection: HttpProtocol, status: int, lines: bytes, body: bytes) -> None:
        admission: Admission | None = cast(Scope, connection.scope).get(ADMISSION)
        connection.answer(status, lines + (END_WITH_KEY if admission and admission.key else END), body)

    def _target(self, connection: HttpProtocol) -> Target:
        target = _target(connection.url, self._root_path)
        assert target is not None
        return target


def _target(url: bytes, root_path: str) -> Target | None:
    """What a URL names, if it is that of an inference route and nothing is encoded."""
    return (_cached_target if len(url) <= MAX_CACHED else _cached_target.__wrapped__)(url, root_path)


@lru_cache(maxsize=4096)
def _cached_target(url: bytes, root_path: str) -> Target | None:
    if not url.isascii() or b"%" in url or b"?" in url or b"#" in url:
        return None
    path = url.decode()
    if root_path and path.startswith(f"{root_path}/"):
        path = path[len(root_path) :]
    if path.startswith(PATH_PREFIX) and path.endswith(PATH_SUFFIX):
        model = path[len(PATH_PREFIX) : -len(PATH_SUFFIX)]
        return Target(path, model, CHAMPION, True) if model and "/" not in model else None
    if not path.startswith(MODELS):
        return None
    match path[len(MODELS) :].split("/"):
        case [model, "infer"] if model:
            return Target(path, model, CHAMPION, False)
        case [model, "versions", version, "infer"] if model and version:
            return Target(path, model, version, False)
    return None
