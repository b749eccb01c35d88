"""Policies of search versions: a replica lets the search service search, a separate deployment of the same application
that is called by handle.
"""

import asyncio
import concurrent.futures
import math
from collections import deque
from collections.abc import AsyncIterator, Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager
from copy import copy
from dataclasses import dataclass, field
from functools import partial
from statistics import median
from time import monotonic
from typing import Any, Self
from weakref import WeakSet

from ray.exceptions import RayError, RayTaskError
from ray.serve.exceptions import BackPressureError, RayServeException
from ray.serve.handle import DeploymentHandle

from league.errors import GraphTimeout, Overloaded, from_document
from league.policies.draws import Generators, UniformNumbers
from league.policies.policy import Arrays
from league.registry.storage.rows import VersionRow
from league.search.searched_actions import SearchedActions
from league.spaces import Space
from serve_app.runtime.background import in_background

SEARCHES = 64
"""Calls of a replica that wait for the search service."""
MESSAGES = 2
"""Messages to each process of the search service that are in progress. The next one has all calls that wait meanwhile:
a message costs a replica more than a call."""
SHARED_ROWS = 64
"""Positions of a call that shares a message, at most: the others of a message wait for its last search."""
PAUSE = 0.1
"""Seconds until a call is repeated whose process has ended."""
LATENCIES = 9
"""Latest messages whose median latency is expected of the next ones: the first ones wait for a process that starts."""


@dataclass(frozen=True, slots=True, eq=False)
class _Call:
    """A call that waits for a message. arguments: of `SearchService.search`."""

    arguments: Callable[[], tuple[object, ...]]
    response: asyncio.Future[dict[str, Any]]


@dataclass(slots=True)
class CallQueue:
    """Calls that wait for the next message, and the number of messages in progress."""

    waiting: list[_Call] = field(default_factory=list)
    messages: int = 0


class SearchClient:
    """Calls the search service through its Ray Serve handle, on the event loop.

    Args:
        handle: Handle of the deployment; see `evaluation.service.search_service`.
        processes: Maximum number of its processes.
    """

    def __init__(self, handle: DeploymentHandle, processes: int) -> None:
        self._handle, self._processes = handle, processes
        self._loop: asyncio.AbstractEventLoop | None = None
        self._policies: WeakSet[RemoteSearch] = WeakSet()
        self._tasks: set[asyncio.Task[None]] = set()
        self._is_used = asyncio.Event()
        self._latencies = deque([0.0], LATENCIES)
        self.threads = ThreadPoolExecutor(SEARCHES, thread_name_prefix="searches")

    @property
    def latency(self) -> float:
        """Expected seconds for which a message and its response are under way, by which searches must end earlier."""
        return median(self._latencies)

    @asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """Accept calls, and keep the search service running while a search version is in memory."""
        self._loop = asyncio.get_running_loop()
        try:
            async with in_background(self._stay()):
                yield
        finally:
            self.threads.shutdown(wait=False, cancel_futures=True)
            for task in self._tasks:
                task.cancel()

    def load(self, version: tuple[str, int, str], seconds: float) -> None:
        """Let the service load a version. Called from a thread. Raises what `search` raises."""
        assert self._loop is not None, "versions are loaded while the replica runs"
        loaded = self._within(seconds, self._call("load", lambda: version))
        asyncio.run_coroutine_threadsafe(loaded, self._loop).result()

    def search(
        self, queue: CallQueue, arguments: Callable[[], tuple[object, ...]], seconds: float
    ) -> "concurrent.futures.Future[dict[str, Any]]":
        """Call `SearchService.search` from a thread.

        Args:
            queue: Its calls share messages.
            arguments: Called for each try: a message whose process ends is repeated.
            seconds: Time limit.

        Returns:
            The response. It raises the error that the search service reported, Overloaded, or GraphTimeout.
        """
        assert self._loop is not None, "versions are loaded while the replica runs"
        return asyncio.run_coroutine_threadsafe(self._search(queue, arguments, seconds), self._loop)

    def keep(self, policy: "RemoteSearch") -> None:
        """Keep the search service running while a policy exists. Called from a thread."""
        assert self._loop is not None, "versions are loaded while the replica runs"
        self._policies.add(policy)
        self._loop.call_soon_threadsafe(self._is_used.set)

    async def _search(
        self, queue: CallQueue, arguments: Callable[[], tuple[object, ...]], seconds: float
    ) -> dict[str, Any]:
        call = _Call(arguments, asyncio.get_running_loop().create_future())
        queue.waiting.append(call)
        self._send(queue)
        return await self._within(seconds, call.response)

    async def _within(self, seconds: float, response: Awaitable[dict[str, Any]]) -> dict[str, Any]:
        try:
            async with asyncio.timeout(seconds):
                document = await response
        except TimeoutError as error:
            # Clients repeat the request: the service may be starting.
            raise GraphTimeout(f"the search service did not respond within {seconds:g} s") from error
        if "code" in document:
            raise from_document(document)
        return document

    def _send(self, queue: CallQueue) -> None:
        queue.waiting = [call for call in queue.waiting if not call.response.done()]
        while queue.waiting and queue.messages < MESSAGES * self._processes:
            size = math.ceil(len(queue.waiting) / self._processes)
            calls, queue.waiting = queue.waiting[:size], queue.waiting[size:]
            queue.messages += 1
            task = asyncio.create_task(self._message(queue, calls))
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)
            for call in calls:
                call.response.add_done_callback(partial(_end_unless_awaited, task, calls))

    async def _message(self, queue: CallQueue, calls: list[_Call]) -> None:
        sent_at = 0.0

        def arguments() -> tuple[list[tuple[object, ...]]]:
            nonlocal sent_at
            sent_at = monotonic()
            return ([call.arguments() for call in calls],)

        try:
            responses = await self._call("searches", arguments)
        except Exception as error:
            for call in calls:
                if not call.response.done():
                    call.response.set_exception(error)
        else:
            latency = monotonic() - sent_at - max(response.get("seconds", math.inf) for response in responses)
            if latency >= 0:  # a process of an earlier release does not tell its part
                self._latencies.append(latency)
            for call, response in zip(calls, responses, strict=True):
                if not call.response.done():  # nobody waits any more
                    call.response.set_result(response)
        finally:
            queue.messages -= 1
            self._send(queue)

    async def _call(self, method: str, arguments: Callable[[], tuple[object, ...]]) -> Any:
        while True:
            try:
                return await getattr(self._handle, method).remote(*arguments())
            except BackPressureError as error:
                raise Overloaded("too many searches wait for the search service") from error
            except RayTaskError:
                raise
            except (RayError, RayServeException):  # its process has ended
                await asyncio.sleep(PAUSE)

    async def _stay(self) -> None:
        while True:
            await self._is_used.wait()
            try:
                await self._handle.stay.remote()
            except (RayError, RayServeException):
                await asyncio.sleep(PAUSE)
            if not self._policies:
                self._is_used.clear()


def _end_unless_awaited(task: asyncio.Task[None], calls: list[_Call], _: object) -> None:
    """End a message for whose calls nobody waits any more."""
    if all(call.response.done() for call in calls):
        task.cancel()


class RemoteSearch:
    """A policy of a search version: for it what OnnxPolicy is for other versions. Its methods block.

    Args:
        client: Client of the search service.
        version: The search version.
        policy: Id of the policy.
        action: Its action space.
        timeout: Seconds after which a search raises GraphTimeout.
    """

    has_distribution = True

    def __init__(self, client: SearchClient, version: VersionRow, policy: str, action: Space, timeout: float) -> None:
        self._client, self._timeout = client, timeout
        self._version, self._policy, self._action = (version.league, version.number, version.sha256), policy, action
        self._deadline, self._with_lines, self._queue = math.inf, False, CallQueue()

    @property
    def threads(self) -> ThreadPoolExecutor:
        """The threads in which to call methods."""
        return self._client.threads

    def load(self, seconds: float) -> None:
        """Let the search service load the version and keep it running. Raises LeagueError."""
        self._client.keep(self)
        self._client.load(self._version, seconds)

    def act(
        self,
        observations: Arrays,
        *,
        state: Arrays | None = None,  # noqa: ARG002
        explore: bool = False,
        rng: Generators | UniformNumbers | None = None,
    ) -> SearchedActions:
        """Search; see Policy.

        Raises:
            ObservationError: An observation is not a position of the game.
            GraphTimeout: It took too long.
            LeagueError: What `SearchClient.search` raises.
        """

        expiry = monotonic() + self._timeout

        def arguments() -> tuple[object, ...]:
            remaining = self._deadline - monotonic() - self._client.latency
            seconds = None if remaining == math.inf else max(0.0, remaining)
            limit = max(0.0, expiry - monotonic())
            return *self._version, self._policy, dict(observations), seconds, limit, self._with_lines

        rows = len(next(iter(observations.values())))
        queue = self._queue if rows <= SHARED_ROWS else CallQueue()
        call = self._client.search(queue, arguments, self._timeout)
        return SearchedActions.of(call.result(), self._action, explore, rng)

    def distribution(self, observations: Arrays, *, state: Arrays | None = None) -> SearchedActions:
        """The same as `act` without `explore`."""
        return self.act(observations, state=state)

    def outputs(self, observations: Arrays, *, state: Arrays | None = None) -> SearchedActions:
        """The same as `act` without `explore`."""
        return self.act(observations, state=state)

    def within(self, timeout: float) -> Self:
        """See `OnnxPolicy.within`."""
        policy = copy(self)
        policy._timeout, policy._queue = timeout, CallQueue()
        return policy

    def bounded(self, deadline: float, with_lines: bool = False) -> Self:
        """Return the same policy that ends its searches at a time of `time.monotonic` with the best actions so far.

        with_lines: whether `SearchedActions.lines` are requested.
        """
        policy = copy(self)
        policy._deadline, policy._with_lines = deadline, with_lines
        if deadline < math.inf:  # the other searches of a message may take longer
            policy._queue = CallQueue()
        return policy
