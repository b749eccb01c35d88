"""Runs the binary messages of all streams that arrive in one turn of the event loop together.

A graph needs much less time for a row of a batch than for one alone. A message waits for nothing but the end of the
turn.
"""

from asyncio import AbstractEventLoop
from collections.abc import Callable, Generator
from itertools import accumulate
from typing import NamedTuple

import numpy as np

from league.errors import GraphTimeout, LeagueError
from league.policies.policy import Actions
from serve_app.inference.action_request import Arrays
from serve_app.live_versions.policies import ActionOptions, LoadedPolicy
from serve_app.runtime.ray_serve import logger

Outcome = Actions | Exception


class StreamBatches:
    """The messages that wait for the end of this turn."""

    def __init__(self) -> None:
        self._waiting: list[tuple[_Run, Callable[[Outcome], None]]] = []

    async def act(self, policy: LoadedPolicy, observations: Arrays, rows: int, options: ActionOptions) -> Actions:
        """Choose actions for the observations of a stream whose protocol knows `Deferred`.

        Large batches, and those of a policy that is too slow for the event loop, run alone in a thread.
        """
        if rows <= policy.inline_rows:
            try:
                return await _Run(self, policy, observations, rows, options)
            except GraphTimeout:
                pass
        return await policy.act(observations, options)

    def add(self, run: "_Run", loop: AbstractEventLoop, go_on: Callable[[Outcome], None]) -> None:
        """Do a run at the end of this turn, and call `go_on` with its outcome."""
        if not self._waiting:
            loop.call_soon(self._take_turn)
        self._waiting.append((run, go_on))

    def _take_turn(self) -> None:
        waiting, self._waiting = self._waiting, []
        groups: dict[tuple[LoadedPolicy, ActionOptions], list[tuple[_Run, Callable[[Outcome], None]]]] = {}
        for run, go_on in waiting:
            groups.setdefault((run.policy, run.options), []).append((run, go_on))
        for (policy, _), group in groups.items():
            while group:
                rows, count = 0, 0
                while count < len(group) and (rows + group[count][0].rows <= policy.inline_rows or not count):
                    rows += group[count][0].rows
                    count += 1
                batch, group = group[:count], group[count:]
                outcomes = _outcomes([run for run, _ in batch], rows)
                for (_, go_on), outcome in zip(batch, outcomes, strict=True):
                    try:
                        go_on(outcome)
                    except Exception as error:  # of this connection only
                        logger.error("an answer of a stream failed", exc_info=error)


class _Run(NamedTuple):
    """The run of one message. Awaiting it returns its actions, or raises its error."""

    batches: StreamBatches
    policy: LoadedPolicy
    observations: Arrays
    rows: int
    options: ActionOptions

    def __await__(self) -> Generator["_Run", Actions, Actions]:
        return (yield self)

    def now(self) -> Outcome:
        """See `Deferred`."""
        return _outcomes([self], self.rows)[0]

    def later(self, loop: AbstractEventLoop, go_on: Callable[[Outcome], None]) -> None:
        """See `Deferred`."""
        self.batches.add(self, loop, go_on)


def _outcomes(runs: list[_Run], rows: int) -> list[Outcome]:
    """Run the messages of one policy as a batch. If that fails, each is run alone."""
    policy, options = runs[0].policy, runs[0].options
    if rows > policy.inline_rows:  # of a batch before this one in the same turn
        return [GraphTimeout("the policy is too slow for the event loop")] * len(runs)
    if len(runs) == 1:
        observations = runs[0].observations
    else:
        names = runs[0].observations
        observations = {name: np.concatenate([run.observations[name] for run in runs]) for name in names}
    try:
        actions = policy.act_inline(observations, options).actions
    except Exception as error:
        if len(runs) > 1 and isinstance(error, LeagueError) and not isinstance(error, GraphTimeout):
            return [run.now() for run in runs]
        return [error] * len(runs)
    ends = accumulate(run.rows for run in runs)
    return [Actions(actions[end - run.rows : end]) for run, end in zip(runs, ends, strict=True)]
