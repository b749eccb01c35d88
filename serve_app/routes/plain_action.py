"""The fast path of inference over HTTP, for requests with nothing but observations.

The connection hands over a request whose body arrived with its head, instead of starting a task for it. All requests of
one turn of the event loop are answered together: decoded and run as one batch per policy and format, without delay for
a request that is alone. Formats are JSON, here, and binary tensors of the Open Inference Protocol. Whatever is not
simple is passed on to the application, which then answers as it would have done: other keys, base64, recurrent state, a
large body or batch, a version that is not in memory, and invalid observations. A request is admitted once, here or by
the middleware.

Requests that arrive faster than they are answered wait in a queue, the oldest first. It has at most `max_waiting`
requests (see `Backlog`), with bodies of at most LARGE_BODY bytes that are not parsed yet. A turn ends after SLICE
seconds, so that new requests are accepted or refused soon.
"""

from asyncio import AbstractEventLoop
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from functools import lru_cache
from time import monotonic, perf_counter_ns
from typing import Any, NamedTuple, cast

import orjson
from starlette.types import Scope

from league.errors import GraphTimeout, LeagueError
from league.policies.policy import Actions
from league.refs import CHAMPION
from serve_app.access.access_control import ADMISSION, KEY_HEADER, Admission
from serve_app.access.errors import ErrorHandlers
from serve_app.codecs.request_limits import LARGE_BODY
from serve_app.inference.action_request import REPLICA, Arrays
from serve_app.inference.plain_format import PlainFormat, PlainRequest, Target, Times
from serve_app.inference_protocol.inference import Inference
from serve_app.inference_protocol.plain_infer import PlainInfer
from serve_app.inference_protocol.rest import HEADER_LENGTH
from serve_app.live_versions.policies import ActionOptions, LoadedPolicy
from serve_app.live_versions.resolver import policy_ref
from serve_app.live_versions.traffic_split import Headers
from serve_app.routes.action import API, PATH_PREFIX, PATH_SUFFIX
from serve_app.runtime.ray_serve import logger
from serve_app.runtime.uvicorn_http import HttpProtocol

NOT_PLAIN = frozenset((b"content-encoding", b"expect", b"transfer-encoding", b"x-request-timeout-ms"))
"""Headers of requests for the application."""
SLICE = 0.005
"""Seconds after which a turn answers no further group of requests."""
GROUP = 32
"""Requests that are parsed and answered together."""
MAX_CACHED = 256
"""Length of the longest URL whose target is cached: callers can send any."""
DEFAULT = ActionOptions()
MODELS = "/v2/models/"
"""Prefix of the paths of the Open Inference Protocol."""


class JsonActions:
    """POST /v1/policies/{model}/action with JSON."""

    api = API

    def __init__(self, max_batch: int) -> None:
        self._max_batch = max_batch

    def parse(self, _: Target, __: Headers, body: bytes, policy: LoadedPolicy) -> tuple["JsonObservations", int] | None:
        """See `PlainFormat`."""
        document = orjson.loads(body)
        if type(document) is not dict or len(document) != 1:
            return None
        is_batch = "observations" in document
        observations = document["observations"] if is_batch else [document["observation"]]
        if type(observations) is not list or not 0 < len(observations) <= self._max_batch:
            return None
        policy.limits.check_size(len(body), len(observations))
        is_plain = body.count(b'"') == 2 * (1 + len(observations) * policy.reader.keys)
        # In one array with those of other requests, booleans would become numbers.
        if not is_plain or b"true" in body or b"false" in body:
            return None
        return JsonObservations(observations, is_batch), len(observations)

    def read(self, policy: LoadedPolicy, contents: Sequence["JsonObservations"], _: int) -> Arrays:
        """See `PlainFormat`."""
        observations = [observation for content in contents for observation in content.observations]
        return policy.reader.read(observations, is_plain=True, is_mixed=len(contents) > 1)

    def options(self, _: Sequence["JsonObservations"]) -> ActionOptions:
        """See `PlainFormat`."""
        return DEFAULT

    def write(self, request: PlainRequest, output: Actions, rows: slice) -> tuple[bytes, bytes]:
        """See `PlainFormat`."""
        actions = output.actions[rows].tolist()
        name, value = (b'{"actions":', actions) if request.content.is_batch else (b'{"action":', actions[0])
        content = name + orjson.dumps(value) + request.policy.signature(request.target.model)
        return b"content-type: application/json\r\ncontent-length: %d\r\n" % len(content), content

    def count(self, _: PlainRequest, __: Times, ___: bool) -> None:
        """See `PlainFormat`."""


class JsonObservations(NamedTuple):
    """The content of a JSON request, not decoded yet."""

    observations: list[Any]
    is_batch: bool


class PlainActions:
    """Answers the plain requests of all connections of a replica."""

    def __init__(
        self,
        inference: Inference,
        errors: ErrorHandlers,
        replica: str,
    ) -> None:
        self._serving = inference.serving
        settings = self._serving.settings
        self._json: PlainFormat = JsonActions(settings.max_batch)
        self._infer: PlainFormat = PlainInfer(inference)
        self._root_path = settings.root_path
        # The application adds the headers for pages of other origins.
        self._not_plain = NOT_PLAIN | ({b"origin"} if settings.cors_origins else set())
        self._errors = errors
        headers = [(REPLICA, replica.encode())]
        self._headers, self._headers_with_key = _lines(headers), _lines([*headers, KEY_HEADER])
        self._arrived: list[HttpProtocol] = []
        """Connections whose request was not admitted yet."""
        self._queue: deque[tuple[int, HttpProtocol]] = deque()
        """Those whose request was, and when: nanoseconds of `perf_counter_ns`."""
        self._has_turn = False

    def takes(self, url: bytes, headers: list[tuple[bytes, bytes]]) -> bool:
        """See `PlainRequests.takes`."""
        target = _target(url, self._root_path)
        if target is None:
            return False
        size, is_binary = LARGE_BODY + 1, False
        for name, value in headers:
            if name == b"content-length":
                size = int(value)
            elif name == HEADER_LENGTH:
                is_binary = True
            elif name in self._not_plain or (
                name == b"content-type" and target.is_action and value != b"application/json"
            ):
                return False
        return size <= LARGE_BODY and (target.is_action or is_binary)

    def add(self, connection: HttpProtocol) -> None:
        """See `PlainRequests.add`."""
        self._arrived.append(connection)
        if not self._has_turn:
            self._has_turn = True
            connection.loop.call_soon(self._take_turn, connection.loop)

    def _take_turn(self, loop: AbstractEventLoop) -> None:
        end = monotonic() + SLICE
        self._admit()
        while self._queue:
            self._answer_group()
            if monotonic() > end:
                break
        self._serving.access.backlog.queued = len(self._queue)
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
            scope, path = cast(Scope, connection.scope), self._target(connection).path
            try:
                scope[ADMISSION] = self._serving.access.admission(scope, path)
                self._queue.append((time, connection))
            except LeagueError as error:
                response = self._errors.response(path, error)
                connection.answer(response.status_code, _lines(response.raw_headers), bytes(response.body))
            except Exception as error:
                logger.error("a plain request was not admitted", exc_info=error)
                connection.pass_on()

    def _answer_group(self) -> None:
        group = [self._queue.popleft() for _ in range(min(GROUP, len(self._queue)))]
        batches: dict[tuple[LoadedPolicy, PlainFormat], list[PlainRequest]] = {}
        try:
            for time, connection in group:
                accepted = self._accept(connection, time)
                if accepted is None:
                    connection.pass_on()
                else:
                    policy, format_of, request = accepted
                    batches.setdefault((policy, format_of), []).append(request)
            for (policy, format_of), requests in batches.items():
                for batch in _batches(requests, policy.inline_rows):
                    self._answer(policy, format_of, batch)
        except Exception as error:
            logger.error("plain requests failed", exc_info=error)
            for _, connection in group:
                if connection.is_waiting:
                    connection.pass_on()

    def _target(self, connection: HttpProtocol) -> Target:
        target = _target(connection.url, self._root_path)
        assert target is not None
        return target

    def _accept(self, connection: HttpProtocol, time: int) -> tuple[LoadedPolicy, PlainFormat, PlainRequest] | None:
        """Parse a request. None if it is to be passed on."""
        scope, target = cast(Scope, connection.scope), self._target(connection)
        admission: Admission = scope[ADMISSION]
        format_of = self._json if target.is_action else self._infer
        try:
            self._serving.check_in_flight(format_of.api)
            if policy_ref(target.model).league in self._serving.traffic.canaries:
                return None
            policy = self._serving.models.find_loaded(target.model, target.version, scope["headers"])
            if policy is None or policy.state:
                return None
            parsed = format_of.parse(target, scope["headers"], connection.body, policy)
        except (orjson.JSONDecodeError, KeyError, LeagueError):
            return None
        if parsed is None or parsed[1] > policy.inline_rows:
            return None
        return policy, format_of, PlainRequest(connection, time, target, policy, *parsed, admission.key is not None)

    def _answer(self, policy: LoadedPolicy, format_of: PlainFormat, requests: list[PlainRequest]) -> None:
        contents, rows = [request.content for request in requests], sum(request.rows for request in requests)
        start = perf_counter_ns()
        try:
            if rows > policy.inline_rows:  # of a batch before this one in the same turn
                raise GraphTimeout("the policy is too slow for the event loop")
            arrays, read = format_of.read(policy, contents, rows), perf_counter_ns()
            output, ran = policy.act_inline(arrays, options := format_of.options(contents)), perf_counter_ns()
        except LeagueError as error:
            # After a run that took too long, the application runs the policy in threads.
            for request in requests:
                if isinstance(error, GraphTimeout) or len(requests) == 1:
                    request.connection.pass_on()
                else:
                    self._answer(policy, format_of, [request])
            return
        end, times, is_greedy = 0, Times(start, read, ran), not policy.is_sampled(options)
        for request in requests:
            part = slice(end, end := end + request.rows)
            response = format_of.write(request, output, part)
            if response is None:
                request.connection.pass_on()
                continue
            head, content = response
            mirror = self._serving.shadow.mirror_for(policy)
            if mirror is not None:
                mirrored: Arrays = {name: array[part] for name, array in arrays.items()}
                mirror(mirrored, None, output.actions[part] if is_greedy else None)
            self._reply(request, head, content)
            self._serving.count(format_of.api, policy, request.rows, request.time)
            format_of.count(request, times, part.start == 0)

    def _reply(self, request: PlainRequest, head: bytes, content: bytes) -> None:
        headers = self._headers_with_key if request.has_key else self._headers
        request.connection.answer(200, head + headers, content)


def _batches(requests: list[PlainRequest], rows: int) -> Iterator[list[PlainRequest]]:
    """Divide requests into batches of at most `rows` rows. No request has more."""
    batch: list[PlainRequest] = []
    size = 0
    for request in requests:
        if size + request.rows > rows and batch:
            yield batch
            batch, size = [], 0
        batch.append(request)
        size += request.rows
    yield batch


def _lines(headers: Iterable[tuple[bytes, bytes]]) -> bytes:
    """The lines of headers, and the empty line after them."""
    return b"".join(b"%b: %b\r\n" % header for header in headers) + b"\r\n"


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
