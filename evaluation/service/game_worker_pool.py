"""Pool of worker processes for games that people watch or play, one process per league.

    GameWorkerPool.submit → the league's thread → pipe → evaluation.service.game_worker

The thread serialises a league's requests, because an environment plays one game at a time. A game that hangs delays its
own league only, until the deadline. Responses are cached, so that a request that takes longer than an HTTP request may
last can be repeated.
"""

from __future__ import annotations

import asyncio
import json
import time
from collections import OrderedDict
from concurrent.futures import Future, ThreadPoolExecutor

from league.errors import GameHung, NotReady, Overloaded, WorkerLost
from league.service_requests import GameRequest, GameResponse
from league.subprocesses import RequestProcess

SECONDS = 60.0
"""Time limit of one request. A video of several hundred frames takes half of it."""
GRACE = 5.0
"""Additional seconds until a process that does not give up by itself is killed."""
START_TIMEOUT = 60.0
"""Seconds for a process to start."""
MOST_WORKERS = 4
"""Leagues with a process. The least recently used idle process makes room for another league."""
MOST_WAITING = 16
"""Unanswered requests of one league."""
IDLE = 300.0
"""Seconds after the last request until the games that were shown or played are considered over."""
MOST_CACHED, CACHE_BYTES = 256, 64 * 2**20
"""Cached responses, and their total size in bytes."""


class GameWorkerPool:
    """Called from one event loop.

    seconds: time limit of one request. grace: seconds after that until the process is killed. most: processes.
    """

    def __init__(self, seconds: float = SECONDS, grace: float = GRACE, most: int = MOST_WORKERS) -> None:
        self._seconds, self._grace, self._most = seconds, grace, most
        self._workers: OrderedDict[str, _LeagueWorker] = OrderedDict()
        self._cache: OrderedDict[str, Future[GameResponse]] = OrderedDict()
        self._used_until = time.monotonic()

    @property
    def is_in_use(self) -> bool:
        """Whether the last request is less than IDLE seconds ago."""
        return time.monotonic() < self._used_until

    async def submit(self, request: GameRequest, timeout: float) -> GameResponse:
        """Return the response if it arrives within `timeout` seconds. Otherwise its computation continues.

        Raises:
            NotReady: The timeout expired. Repeat the same request.
            Overloaded: Too many requests are waiting.
            GameHung: The request exceeded its time limit.
            WorkerLost: The process died.
            LeagueError: The error that the worker reported.
            OSError: No process can be started.
        """
        self._used_until = time.monotonic() + IDLE
        line = request.model_dump_json()
        response = self._cache.get(line)
        if response is None or (response.done() and not request.is_cacheable):
            response = self._cache[line] = self._worker(request.league).submit(line)
        self._cache.move_to_end(line)
        self._evict()
        try:
            return await asyncio.wait_for(asyncio.shield(asyncio.wrap_future(response)), timeout)
        except TimeoutError:
            raise NotReady(
                f"the environment of {request.league} is starting or busy: repeat the request for its response"
            ) from None
        except Exception:
            if self._cache.get(line) is response:
                del self._cache[line]  # errors are not cached
            raise

    def close(self) -> None:
        """End all processes."""
        while self._workers:
            self._workers.popitem()[1].close()

    def _worker(self, league: str) -> _LeagueWorker:
        if league not in self._workers:
            if len(self._workers) >= self._most:
                idle = next((other for other, worker in self._workers.items() if not worker.is_busy), None)
                if idle is None:
                    raise Overloaded(f"all {self._most} processes for games are in use by other leagues: retry soon")
                self._workers.pop(idle).retire()
            self._workers[league] = _LeagueWorker(league, self._seconds, self._grace)
        self._workers.move_to_end(league)
        return self._workers[league]

    def _evict(self) -> None:
        """Remove the oldest responses beyond the limits of the cache."""
        sizes = {line: _size(response) for line, response in self._cache.items() if response.done()}
        over, room = len(self._cache) - MOST_CACHED, CACHE_BYTES - sum(sizes.values())
        for line, size in sizes.items():
            if over <= 0 and room >= 0:
                return
            del self._cache[line]
            over, room = over - 1, room + size


class _LeagueWorker:
    """The process of one league and the thread that its requests wait in."""

    def __init__(self, league: str, seconds: float, grace: float) -> None:
        self._league, self._timeout = league, seconds + grace
        self._thread = ThreadPoolExecutor(1, f"games-{league}")
        self._pending: list[Future[GameResponse]] = []
        self._process = RequestProcess(
            "evaluation.service.game_worker",
            json.dumps({"league": league, "seconds": seconds}),
            work=f"plays games of {league}",
            start_timeout=START_TIMEOUT,
        )

    @property
    def is_busy(self) -> bool:
        """Whether it has unanswered requests."""
        return any(not response.done() for response in self._pending)

    def submit(self, line: str) -> Future[GameResponse]:
        """Queue a request. Raises Overloaded."""
        self._pending = [response for response in self._pending if not response.done()]
        if len(self._pending) >= MOST_WAITING:
            raise Overloaded(f"{len(self._pending)} games of {self._league} are waiting: retry soon")
        self._pending.append(self._thread.submit(self._request, line))
        return self._pending[-1]

    def retire(self) -> None:
        """End the idle process in its thread, as its environment may take long to close."""
        self._thread.submit(self._process.close)
        self._thread.shutdown(wait=False)

    def close(self) -> None:
        """End the process."""
        self._thread.shutdown(wait=False, cancel_futures=True)
        self._process.close()

    def _request(self, line: str) -> GameResponse:
        is_old = self._process.pid is not None
        try:
            try:
                head, content = self._process.request(line, self._timeout)
            except WorkerLost:
                if not is_old:
                    raise
                # The process may have died before, for another reason.
                head, content = self._process.request(line, self._timeout)
        except TimeoutError as error:
            raise GameHung(
                f"a game of {self._league} hung: its process was killed after {self._timeout:g} s"
            ) from error
        return GameResponse(head["media_type"], content)


def _size(response: Future[GameResponse]) -> int:
    return 0 if response.exception() else len(response.result().content)
