"""The shadow: requests that the champion has answered are shown to a candidate, and the answers are compared.

    request → champion → reply
                 ↘ waiting (bounded) → in a thread, later: candidate → same action? how long? → counts

Nobody waits for it. Requests are collected for a moment and computed together, in a thread that rests as long as keeps
it to its share of a core; what comes meanwhile and finds no room is dropped, and counted. Of requests that are computed
together the first is computed alone, and timed, in time of the processor: neither the others nor the wait for Python's
lock count for the candidate.
"""

import asyncio
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from random import random
from time import thread_time_ns
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from league.histograms import Histogram
from league.policies.agreement import same
from league.policies.policy import Arrays
from league.registry.rows import Shadowing
from serve_app.live import Live, logger
from serve_app.loading import LoadedPolicy, LoadedVersion
from serve_app.models import policy_ref
from serve_app.settings import ServeSettings
from serve_app.traffic import Traffic

WINDOW = 0.05
"""Seconds for which requests are collected: the fewer wake-ups, the less the event loop has to share."""
TOLERANCE = 0.01
"""Numbers of a continuous action that differ by less than this share of their span count as the same."""
MOST_BYTES = 16 * 2**20
"""Observations that wait take no more than that."""
MOST_ROWS = 256
"""Observations that are computed at once, unless one request has more."""

Show = Callable[[Arrays, Arrays | None, NDArray | None], None]
"""Takes the observations of a request, its recurrent state, and the champion's greedy actions, None if others were
taken."""


class Mirrored(NamedTuple):
    """A request that waits."""

    candidate: LoadedVersion
    champion: LoadedVersion
    policy: str | None
    observations: Arrays
    actions: NDArray | None


@dataclass(slots=True)
class Tally:
    """What is counted of a candidate against a champion; see league.registry.rows.Shadowing."""

    requests: int = 0
    observations: int = 0
    agreed: int = 0
    failed: int = 0
    dropped: int = 0
    skipped: int = 0
    latency: Histogram = field(default_factory=Histogram)


@dataclass(slots=True)
class Outcome:
    """What came of some requests for the same policy of the same candidate and champion."""

    pair: tuple[str, int, int]
    requests: int = 0
    observations: int = 0
    agreed: int = 0
    failed: int = 0
    ns: int | None = None
    """How long it took, where one was computed alone."""
    fault: str | None = None


class Shadow:
    """Shows requests to candidates. All methods run on the event loop."""

    def __init__(self, live: Live, traffic: Traffic, settings: ServeSettings) -> None:
        self._live = live
        self._traffic = traffic
        self._settings = settings
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="shadow")
        self._tallies: dict[tuple[str, int, int], Tally] = {}
        self._waiting: list[Mirrored] = []
        self._bytes = 0
        self._is_begun = False

    def of(self, model: str, version: LoadedVersion) -> Show | None:
        """What a request of `model` that `version` answers is to be shown to; None for nothing."""
        side = self._traffic.shadows.get(version.league)
        if side is None or (side.share < 1 and random() >= side.share):
            return None
        candidate = self._live.get(version.league, side.slot)
        if candidate is None or candidate is version or version is not self._live.champion(version.league):
            return None
        policy = policy_ref(model).policy

        def show(observations: Arrays, state: Arrays | None, actions: NDArray | None) -> None:
            self._offer(Mirrored(candidate, version, policy, observations, actions), is_first=state is None)

        return show

    def shadowings(self) -> list[Shadowing]:
        """What was counted since this replica started."""
        return [
            Shadowing(
                *pair,
                tally.requests,
                tally.observations,
                tally.agreed,
                tally.failed,
                tally.dropped,
                tally.skipped,
                tuple(tally.latency.counts),
                tally.latency.ns,
            )
            for pair, tally in sorted(self._tallies.items())
        ]

    def close(self) -> None:
        """Compute nothing more."""
        self._thread.shutdown(wait=False, cancel_futures=True)

    def _offer(self, request: Mirrored, is_first: bool) -> None:
        """is_first: whether it has no recurrent state, which would be another network's."""
        tally = self._tally(_pair(request))
        if not is_first:
            tally.skipped += 1
            return
        size = sum(array.nbytes for array in request.observations.values())
        if len(self._waiting) >= self._settings.shadow_waiting or self._bytes + size > MOST_BYTES:
            tally.dropped += 1
            return
        self._waiting.append(request)
        self._bytes += size
        if not self._is_begun:
            self._is_begun = True
            asyncio.get_running_loop().call_later(WINDOW, self._begin)

    def _begin(self) -> None:
        requests, self._waiting, self._bytes = self._waiting, [], 0
        if not requests:
            self._is_begun = False
            return
        loop = asyncio.get_running_loop()
        try:
            computing = loop.run_in_executor(self._thread, compare, requests)
        except RuntimeError:  # closed meanwhile
            return
        computing.add_done_callback(self._end)

    def _end(self, computing: asyncio.Future[tuple[list[Outcome], float]]) -> None:
        if computing.cancelled():
            return
        outcomes, seconds = computing.result()
        for outcome in outcomes:
            tally = self._tally(outcome.pair)
            if outcome.fault is not None and not tally.failed:
                logger.error("%s@%d does not answer what is mirrored to it: %s", *outcome.pair[:2], outcome.fault)
            tally.requests += outcome.requests
            tally.observations += outcome.observations
            tally.agreed += outcome.agreed
            tally.failed += outcome.failed
            if outcome.ns is not None:
                tally.latency.add(outcome.ns)
        rest = max(WINDOW, seconds * (1 / self._settings.shadow_load - 1))
        asyncio.get_running_loop().call_later(rest, self._begin)

    def _tally(self, pair: tuple[str, int, int]) -> Tally:
        if (tally := self._tallies.get(pair)) is None:
            tally = self._tallies[pair] = Tally()
        return tally


def compare(requests: Sequence[Mirrored]) -> tuple[list[Outcome], float]:
    """Let candidates answer; returns what came of it, and the seconds of the processor that it took."""
    begun = thread_time_ns()
    alike: dict[tuple[int, int, str | None], list[Mirrored]] = {}
    for request in requests:
        alike.setdefault((id(request.candidate), id(request.champion), request.policy), []).append(request)
    outcomes = []
    for group in alike.values():
        first, rest = group[:1], group[1:]
        outcomes.append(_outcome(first, is_timed=True))
        outcomes += [_outcome(part, is_timed=False) for part in _parts(rest)]
    return outcomes, (thread_time_ns() - begun) / 1e9


def _parts(requests: Sequence[Mirrored]) -> list[list[Mirrored]]:
    """Requests that are computed at once, in order."""
    parts: list[list[Mirrored]] = []
    rows = MOST_ROWS
    for request in requests:
        if (rows := rows + _rows(request)) > MOST_ROWS:
            parts.append([])
            rows = _rows(request)
        parts[-1].append(request)
    return parts


def _outcome(requests: Sequence[Mirrored], is_timed: bool) -> Outcome:
    outcome = Outcome(_pair(requests[0]))
    try:
        candidate = requests[0].candidate.policy(requests[0].policy)
        observations = _stacked([request.observations for request in requests])
        begun = thread_time_ns()
        actions = candidate.policy.act(observations).actions
        taken = thread_time_ns() - begun
        expected = _expected(requests, requests[0].champion.policy(requests[0].policy), observations)
        outcome.agreed = int(same(actions, expected, candidate.manifest.action, TOLERANCE).sum())
    except Exception as error:  # whatever it is, it is the candidate's, and nobody else's concern
        outcome.failed, outcome.fault = len(requests), f"{type(error).__name__}: {error}"
        return outcome
    outcome.requests, outcome.observations = len(requests), len(actions)
    outcome.ns = taken if is_timed else None
    return outcome


def _expected(requests: Sequence[Mirrored], champion: LoadedPolicy, observations: Arrays) -> NDArray:
    """The champion's greedy actions, computed again where it was not those that it took."""
    known = [request.actions for request in requests if request.actions is not None]
    if len(known) < len(requests):
        return champion.policy.act(observations).actions
    return np.concatenate(known)


def _stacked(batches: Sequence[Arrays]) -> Arrays:
    if len(batches) == 1:
        return batches[0]
    return {name: np.concatenate([batch[name] for batch in batches]) for name in batches[0]}


def _rows(request: Mirrored) -> int:
    return len(next(iter(request.observations.values())))


def _pair(request: Mirrored) -> tuple[str, int, int]:
    return request.champion.league, request.candidate.number, request.champion.number
