"""Ray Serve deployment that searches for search versions.

deploy.yaml refers to it by import string; replicas of the policy server call it by handle and never import it. Its
processes import environments, and search with a lower priority than replicas. They keep loaded versions only, so each
can be killed and started again at any time.

It runs only while a replica has a search version in memory: such replicas call `stay`.
"""

import asyncio
import math
import os
import time
from collections import OrderedDict
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from league.search.policies import SearchPolicy

STAY = 10.0
"""Seconds for which a call of `stay` keeps the deployment running."""
MOST_VERSIONS, MOST_ROWS = 8, 256
"""Versions in memory, and positions that are searched together, unless one request has more."""
MESSAGES = 64
"""Messages with calls in progress of a process, of which further ones wait for another process."""
NICENESS = 5
"""Of the thread that searches: threads have priorities of their own."""


@dataclass(frozen=True, slots=True, eq=False)
class _Call:
    """A call that waits for its turn. deadline, expiry: when the search ends, and when nobody waits for it any more, of
    `time.monotonic`."""

    version: tuple[str, int, str]
    policy: str
    observations: dict[str, Any]
    deadline: float
    expiry: float
    with_lines: bool
    result: asyncio.Future[dict[str, Any]]


class SearchService:
    """A process of the deployment. LEAGUE_HOME and related variables locate its leagues.

    One search runs at a time. Calls that arrive meanwhile for the same version are then searched together.
    """

    def __init__(self) -> None:
        from league.registry.registry import Registry
        from league.settings import Storage

        self._registry = Registry.open(Storage.from_environment(), create=False)
        self._policies: OrderedDict[tuple[str, int, str], dict[str, SearchPolicy]] = OrderedDict()
        self._waiting: list[_Call] = []
        self._thread = ThreadPoolExecutor(1, "search", os.nice, (NICENESS,))
        self._work: asyncio.Task[None] | None = None

    async def stay(self) -> None:
        """Keep the deployment running for a while."""
        await asyncio.sleep(STAY)

    async def load(self, league: str, number: int, sha256: str) -> dict[str, Any]:
        """Load a search version, unless it is loaded. Returns `{}`, or `{"code", "message"}` of an error.

        sha256: of its manifest.
        """
        from league.errors import LeagueError, to_document

        loop = asyncio.get_running_loop()
        try:
            await loop.run_in_executor(self._thread, self._load, (league, number, sha256))
            return {}
        except LeagueError as error:
            return to_document(error)

    async def searches(self, calls: Sequence[tuple[Any, ...]]) -> list[dict[str, Any]]:
        """Call `search` for each of several tuples of its arguments, and return the results in order."""
        return await asyncio.gather(*(self.search(*call) for call in calls))

    async def search(
        self,
        league: str,
        number: int,
        sha256: str,
        policy: str,
        observations: dict[str, Any],
        seconds: float | None,
        limit: float,
        with_lines: bool,
    ) -> dict[str, Any]:
        """Search from k positions.

        Args:
            league, number, sha256: The search version, and the digest of its manifest.
            policy: Id of the policy.
            observations: Arrays (k, …).
            seconds: After which to end with the best actions so far; None for all simulations.
            limit: Seconds for which the caller waits. A search without callers ends.
            with_lines: Whether to return the moves that the search expects.

        Returns:
            The fields of SearchResult, and `ns`, the processor time, and `seconds`, since the call arrived; or
            `{"code", "message"}` of an error.
        """
        current_time = time.monotonic()
        deadline = math.inf if seconds is None else current_time + seconds
        result = asyncio.get_running_loop().create_future()
        version = (league, number, sha256)
        self._waiting.append(_Call(version, policy, observations, deadline, current_time + limit, with_lines, result))
        if self._work is None or self._work.done():
            self._work = asyncio.create_task(self._answer_all())
        return await result | {"seconds": time.monotonic() - current_time}

    async def _answer_all(self) -> None:
        loop = asyncio.get_running_loop()
        while self._waiting:
            batch = [call for call in self._next_batch() if not call.result.done()]
            if not batch:
                continue
            try:
                results = await loop.run_in_executor(self._thread, self._answer, batch)
            except Exception as error:
                results = [error] * len(batch)
            for call, result in zip(batch, results, strict=True):
                if call.result.done():  # cancelled
                    continue
                if isinstance(result, Exception):
                    call.result.set_exception(result)
                else:
                    call.result.set_result(result)

    def _next_batch(self) -> list[_Call]:
        """Remove the first call and others that can be searched with it. One with a deadline is searched alone."""
        first, rows = self._waiting[0], 0
        batch: list[_Call] = []
        for call in self._waiting:
            alike = call.version == first.version and call.policy == first.policy
            alone = min(first.deadline, call.deadline) < math.inf
            if call is first or (alike and not alone and rows + _rows(call) <= MOST_ROWS):
                batch.append(call)
                rows += _rows(call)
        self._waiting = [call for call in self._waiting if call not in batch]
        return batch

    def _answer(self, batch: Sequence[_Call]) -> list[Any]:
        """Search for calls of one policy. An error of one of them does not concern the others."""
        import numpy as np

        from league.errors import LeagueError, to_document
        from league.search.searched_actions import MOVES

        first = batch[0]
        try:
            policy = self._load(first.version)[first.policy]
            names = first.observations
            observations = {name: np.concatenate([call.observations[name] for call in batch]) for name in names}
            began = time.thread_time_ns()
            moves = MOVES if any(call.with_lines for call in batch) else 0
            deadline = min(first.deadline, max(call.expiry for call in batch))
            result = policy.search(observations, deadline, moves)
            ns = time.thread_time_ns() - began
            columns = {name: getattr(result, name) for name in result.__slots__}
        except LeagueError as error:
            if len(batch) > 1:
                return [answer for call in batch for answer in self._answer([call])]
            return [to_document(error)]
        answers, end = [], 0
        for call in batch:
            part = slice(end, end := end + _rows(call))
            fields = {name: column[part] for name, column in columns.items()}
            answers.append(fields | {"ns": ns * _rows(call) // len(result.actions)})
        return answers

    def _load(self, version: tuple[str, int, str]) -> dict[str, "SearchPolicy"]:
        """The policies of a version by id. Raises LeagueError."""
        from league.errors import VersionRetired
        from league.search.policies import search_policies

        if version not in self._policies:
            league, number, sha256 = version
            row, current = self._registry.leagues.get(league), self._registry.versions.get(league, number)
            if current.search is None or current.sha256 != sha256:
                raise VersionRetired(f"{current.ref} was replaced by another version")
            base, search = self._registry.versions.get(league, current.search.version), current.search
            self._policies[version] = search_policies(
                base, search.rule, search.simulations, self._registry, row.interface, row.config.environment
            )
            if len(self._policies) > MOST_VERSIONS:
                self._policies.popitem(last=False)
        self._policies.move_to_end(version)
        return self._policies[version]


def _rows(call: _Call) -> int:
    return len(next(iter(call.observations.values())))


def deployment(most_processes: int) -> Any:
    """The bound deployment, which starts up to `most_processes` processes as calls wait.

    It reserves no CPU, so that it never prevents a replica from starting. `deployments` in deploy.yaml can override its
    options under the name `SearchService`.
    """
    from ray import serve

    options = serve.deployment(
        name="SearchService",
        autoscaling_config={
            "min_replicas": 0,
            "max_replicas": most_processes,
            "target_ongoing_requests": 4,  # besides messages with searches, each replica calls `stay`
            "metrics_interval_s": 1,
            "look_back_period_s": 4,
            "upscale_delay_s": 2,
            "downscale_delay_s": 60,
            "downscale_to_zero_delay_s": 30,
        },
        ray_actor_options={"num_cpus": 0},
        max_queued_requests=MESSAGES,
        max_ongoing_requests=MESSAGES,
        health_check_period_s=2,
        health_check_timeout_s=10,
        graceful_shutdown_wait_loop_s=0.1,
        graceful_shutdown_timeout_s=5,
        logging_config={"log_level": "WARNING", "enable_access_log": False},
    )
    return options(SearchService).bind()
