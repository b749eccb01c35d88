"""Runs the requests of all connections that arrive in one turn of the event loop together.

A graph needs much less time for a row of a batch than for one alone. A request waits for nothing but the end of the
turn. Requests of one batch are for the same policy, choose actions in the same way, and are of the same format; their
observations are decoded together, too.
"""

import asyncio
from collections.abc import Callable, Generator, Iterator, Sequence
from itertools import accumulate
from time import perf_counter_ns
from typing import Any, NamedTuple, Protocol

from numpy.typing import NDArray

from league.errors import GraphTimeout
from league.policies.policy import Actions, Arrays
from serve_app.live_versions.policies import ActionOptions, LoadedPolicy
from serve_app.runtime.ray_serve import logger


class RequestRows(Protocol):
    """The observations of a request, as its format has parsed them."""

    @property
    def rows(self) -> int:
        """Their number."""

    @property
    def is_joinable(self) -> bool:
        """Whether they may be decoded together with those of other requests."""

    @property
    def is_large(self) -> bool:
        """Whether decoding them takes too long for the event loop."""

    @staticmethod
    def read(policy: LoadedPolicy, parts: Sequence[Any]) -> Arrays:
        """The inputs of the graph for the observations of several requests, or of one. Raises LeagueError."""


class Answer(NamedTuple):
    """The actions of a request, and how they came about. Times are those of `perf_counter_ns`."""

    output: Actions
    """Those of the batch."""
    batch: Arrays
    """The inputs of the graph."""
    rows: slice
    """Those of this request."""
    started: int
    read: int
    """When the observations were decoded."""
    ran: int
    runs: int = 1
    """0 if the run of the batch is counted for another request."""

    @property
    def actions(self) -> NDArray:
        """The actions."""
        return self.output.actions[self.rows]

    @property
    def dist_inputs(self) -> NDArray | None:
        """See `Actions`."""
        return None if self.output.dist_inputs is None else self.output.dist_inputs[self.rows]

    @property
    def inputs(self) -> dict[str, NDArray]:
        """The inputs of the graph."""
        return {name: array[self.rows] for name, array in self.batch.items()}


Outcome = Answer | Exception | None
"""None if the policy is too slow for the event loop."""
GoOn = Callable[[Outcome], None]


class GraphRun(NamedTuple):
    """The run of one request. Awaiting it returns its outcome, or raises its error.

    What drives a coroutine by hand receives the run, and lets it wait for the end of the turn. A task does not wait.
    """

    batches: "Batches"
    policy: LoadedPolicy
    observations: RequestRows
    options: ActionOptions

    def __await__(self) -> Generator["GraphRun", Answer | None, Answer | None]:
        if asyncio.current_task() is None:
            return (yield self)
        outcome = self.now()
        if isinstance(outcome, Exception):
            raise outcome
        return outcome

    def now(self) -> Outcome:
        """See `Deferred`."""
        return _outcomes([self])[0]

    def later(self, loop: asyncio.AbstractEventLoop, go_on: GoOn) -> None:
        """See `Deferred`."""
        self.batches.add(self, loop, go_on)


class Batches:
    """The runs that wait for the end of this turn."""

    def __init__(self) -> None:
        self._waiting: list[tuple[GraphRun, GoOn]] = []

    def add(self, run: GraphRun, loop: asyncio.AbstractEventLoop, go_on: GoOn) -> None:
        """Do a run at the end of this turn, and call `go_on` with its outcome."""
        if not self._waiting:
            loop.call_soon(self.flush)
        self._waiting.append((run, go_on))

    def flush(self) -> None:
        """Do the runs now."""
        waiting, self._waiting = self._waiting, []
        groups: dict[tuple[Any, ...], list[tuple[GraphRun, GoOn]]] = {}
        for run, go_on in waiting:
            groups.setdefault((run.policy, run.options, type(run.observations)), []).append((run, go_on))
        for (policy, *_), group in groups.items():
            for batch in _batches(group, policy.inline_rows):
                outcomes = _outcomes([run for run, _ in batch])
                for (_, go_on), outcome in zip(batch, outcomes, strict=True):
                    try:
                        go_on(outcome)
                    except Exception as error:  # of this connection only
                        logger.error("an answer failed", exc_info=error)


def _batches(group: list[tuple[GraphRun, GoOn]], rows: int) -> Iterator[list[tuple[GraphRun, GoOn]]]:
    """Divide runs into batches of at most `rows` rows. No run has more."""
    size, begin = 0, 0
    for place, (run, _) in enumerate(group):
        size += run.observations.rows
        if size > rows and place > begin:
            yield group[begin:place]
            size, begin = run.observations.rows, place
    yield group[begin:]


def _outcomes(runs: list[GraphRun]) -> list[Outcome]:
    """Run requests as a batch. If that fails, each is run alone."""
    policy, observations, options = runs[0][1:]
    rows = [run.observations.rows for run in runs]
    if sum(rows) > policy.inline_rows:  # because of a batch before this one in the same turn
        return [None] * len(runs)
    started = perf_counter_ns()
    try:
        batch, read = observations.read(policy, [run.observations for run in runs]), perf_counter_ns()
        output = policy.act_inline(batch, options)
    except GraphTimeout:
        return [None] * len(runs)
    except Exception as error:
        return [error] if len(runs) == 1 else [run.now() for run in runs]
    ran, ends = perf_counter_ns(), list(accumulate(rows))
    return [
        Answer(output, batch, slice(end - count, end), started, read, ran, int(end == count))
        for count, end in zip(rows, ends, strict=True)
    ]
