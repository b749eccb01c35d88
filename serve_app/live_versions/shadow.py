"""Mirrors requests that the champion has answered to a candidate, and compares their actions.

    request → champion → response
                 ↘ bounded queue → thread: candidate → same action? latency? → counts

A run that takes long, or continues after the shadow was switched off, is ended.

Callers are unaffected. Requests are batched in a thread that pauses between batches to stay within its share of a core;
requests that exceed it are dropped and counted. The first request of a batch runs alone and is timed in CPU time, so
that neither other requests nor waiting for the GIL count as the candidate's latency.
"""

import asyncio
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from random import random
from time import thread_time_ns
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from league.errors import GraphTimeout, one_line
from league.histograms import Histogram
from league.policies.policy import Actions, Arrays
from league.policies.probes import same
from league.random.seeds import generators
from league.registry.storage.rows import ShadowCounts
from league.search.searched_actions import SearchedActions
from serve_app.live_versions.alias_slots import AliasSlots
from serve_app.live_versions.policies import Graph, LoadedPolicy, LoadedVersion
from serve_app.live_versions.traffic_split import TrafficSplit, acting
from serve_app.runtime.ray_serve import logger
from serve_app.settings import ServeSettings

BATCH_WINDOW = 0.05
"""Seconds for which requests are collected. Fewer wake-ups take less time from the event loop."""
TOLERANCE = 0.01
"""Continuous actions are equal if they differ by less than this share of their range."""
MAX_WAITING_BYTES = 16 * 2**20
"""Maximum size of queued observations."""
MAX_ROWS = 256
"""Maximum observations per batch, unless one request has more."""

MirrorFunction = Callable[[Arrays, Arrays | None, NDArray | None], None]
"""Takes the observations of a request, its recurrent state, and the champion's greedy actions, or None if they were
sampled."""


class MirroredRequest(NamedTuple):
    """A queued request."""

    candidate: LoadedVersion
    champion: LoadedPolicy
    observations: Arrays
    actions: NDArray | None


@dataclass(slots=True)
class Tally:
    """Running counts of a candidate compared with a champion; see league.registry.storage.rows.ShadowCounts."""

    requests: int = 0
    observations: int = 0
    agreed: int = 0
    failed: int = 0
    dropped: int = 0
    skipped: int = 0
    latency: Histogram = field(default_factory=Histogram)


@dataclass(slots=True)
class ShadowResult:
    """The result of requests for one policy of one candidate and champion."""

    pair: tuple[str, int, int]
    requests: int = 0
    observations: int = 0
    agreed: int = 0
    failed: int = 0
    ns: int | None = None
    """CPU time of a request that ran alone, of a search that of the search service."""
    searched_ns: int = 0
    """CPU time of the search service."""
    fault: str | None = None
    is_late: bool = False
    """Whether a run was ended."""


class Shadow:
    """Mirrors requests to candidates. All methods run on the event loop."""

    def __init__(self, slots: AliasSlots, traffic: TrafficSplit, settings: ServeSettings) -> None:
        self._slots = slots
        self._traffic = traffic
        self._settings = settings
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="shadow")
        self._counts: dict[tuple[str, int, int], Tally] = {}
        self._waiting: list[MirroredRequest] = []
        self._bytes = 0
        self._is_scheduled = False

    def mirror_for(self, policy: LoadedPolicy) -> MirrorFunction | None:
        """The function that mirrors a request that `policy` answers; None if it is not mirrored."""
        target = self._traffic.shadows.get(policy.league)
        if target is None or (target.share < 1 and random() >= target.share):
            return None
        candidate, champion = self._slots.get(policy.league, target.slot), self._slots.champion(policy.league)
        if candidate is None or champion is None or candidate is champion:
            return None
        if all(version.policies.get(policy.name) is not policy for version in (champion, *champion.members)):
            return None
        candidate = acting(candidate, ())
        if candidate.policies.get(policy.name) is policy:
            return None

        def mirror(observations: Arrays, state: Arrays | None, actions: NDArray | None) -> None:
            request = MirroredRequest(candidate, policy, observations, actions)
            counts = self._counts_of(_pair(request))
            if state is not None:  # it would be another network's
                counts.skipped += 1
                return
            size = sum(array.nbytes for array in observations.values())
            if len(self._waiting) >= self._settings.shadow_waiting or self._bytes + size > MAX_WAITING_BYTES:
                counts.dropped += 1
                return
            self._waiting.append(request)
            self._bytes += size
            if not self._is_scheduled:
                self._is_scheduled = True
                asyncio.get_running_loop().call_later(BATCH_WINDOW, self._start_batch)

        return mirror

    def shadowings(self) -> list[ShadowCounts]:
        """All counts since this replica started."""
        return [
            ShadowCounts(
                *pair,
                counts.requests,
                counts.observations,
                counts.agreed,
                counts.failed,
                counts.dropped,
                counts.skipped,
                tuple(counts.latency.counts),
                counts.latency.ns,
            )
            for pair, counts in sorted(self._counts.items())
        ]

    def close(self) -> None:
        """Stop the thread."""
        self._thread.shutdown(wait=False, cancel_futures=True)

    def _start_batch(self) -> None:
        requests, self._waiting, self._bytes = self._waiting, [], 0
        if not requests:
            self._is_scheduled = False
            return
        loop = asyncio.get_running_loop()
        candidates = list({id(request.candidate): request.candidate for request in requests}.values())
        try:
            computing = loop.run_in_executor(self._thread, compare, requests)
        except RuntimeError:  # closed in the meantime
            return
        computing.add_done_callback(self._finish_batch)
        self._end_if_off(computing, candidates)

    def _end_if_off(self, computing: asyncio.Future[Any], candidates: Sequence[LoadedVersion]) -> None:
        """End the runs of versions that are no longer shadows, until the batch is finished."""
        if computing.done():
            return
        for candidate in candidates:
            target = self._traffic.shadows.get(candidate.league)
            shadow = None if target is None else self._slots.get(candidate.league, target.slot)
            if shadow is None or all(candidate is not version for version in (shadow, *shadow.members)):
                for policy in candidate.policies.values():
                    policy.shadow_graph.end_runs()
        asyncio.get_running_loop().call_later(BATCH_WINDOW, self._end_if_off, computing, candidates)

    def _finish_batch(self, computing: asyncio.Future[tuple[list[ShadowResult], float]]) -> None:
        if computing.cancelled():
            return
        outcomes, seconds = computing.result()
        for outcome in outcomes:
            counts = self._counts_of(outcome.pair)
            if outcome.fault is not None and not counts.failed:
                logger.error("%s@%d failed to answer a mirrored request: %s", *outcome.pair[:2], outcome.fault)
            counts.requests += outcome.requests
            counts.observations += outcome.observations
            counts.agreed += outcome.agreed
            counts.failed += outcome.failed
            if outcome.ns is not None:
                counts.latency.add(outcome.ns)
        pause = max(BATCH_WINDOW, seconds * (1 / self._settings.shadow_load - 1))
        asyncio.get_running_loop().call_later(pause, self._start_batch)

    def _counts_of(self, pair: tuple[str, int, int]) -> Tally:
        if (counts := self._counts.get(pair)) is None:
            counts = self._counts[pair] = Tally()
        return counts


def compare(requests: Sequence[MirroredRequest]) -> tuple[list[ShadowResult], float]:
    """Run candidates on requests; returns the results and the CPU time in seconds."""
    start = thread_time_ns()
    alike: dict[tuple[int, int], list[MirroredRequest]] = {}
    for request in requests:
        alike.setdefault((id(request.candidate), id(request.champion)), []).append(request)
    outcomes = []
    for group in alike.values():
        first, later_requests = group[:1], group[1:]
        outcomes.append(_compare_batch(first, is_timed=True))
        if outcomes[-1].is_late:
            outcomes.append(replace(outcomes[-1], failed=len(later_requests)))
            continue
        outcomes += [_compare_batch(part, is_timed=False) for part in _batches(later_requests)]
    return outcomes, (thread_time_ns() - start + sum(outcome.searched_ns for outcome in outcomes)) / 1e9


def _batches(requests: Sequence[MirroredRequest]) -> list[list[MirroredRequest]]:
    """Requests in batches of at most MAX_ROWS, in order."""
    parts: list[list[MirroredRequest]] = []
    rows = MAX_ROWS
    for request in requests:
        if (rows := rows + _rows(request)) > MAX_ROWS:
            parts.append([])
            rows = _rows(request)
        parts[-1].append(request)
    return parts


def _compare_batch(requests: Sequence[MirroredRequest], is_timed: bool) -> ShadowResult:
    outcome = ShadowResult(_pair(requests[0]))
    try:
        champion = requests[0].champion
        candidate = requests[0].candidate.policy(champion.name)
        names = requests[0].observations
        observations = {name: np.concatenate([request.observations[name] for request in requests]) for name in names}
        seeds = np.random.default_rng().integers(2**63, size=sum(map(_rows, requests)))
        start = thread_time_ns()
        answer = _act(candidate, candidate.shadow_graph, observations, seeds)
        actions, searched_ns = answer.actions, answer.ns if isinstance(answer, SearchedActions) else 0
        cpu_ns = thread_time_ns() - start + searched_ns
        recorded = [request.actions for request in requests if request.actions is not None]
        # The champion's actions are recomputed if they were or are to be sampled.
        if champion.samples or len(recorded) < len(requests):
            expected = _act(champion, champion.graph, observations, seeds).actions
        else:
            expected = np.concatenate(recorded)
        outcome.agreed = int(same(actions, expected, candidate.manifest.action, TOLERANCE).sum())
    except Exception as error:  # any failure is counted against the candidate
        outcome.is_late = isinstance(error, GraphTimeout)
        outcome.failed, outcome.fault = len(requests), one_line(error, with_type=True)
        return outcome
    outcome.requests, outcome.observations, outcome.searched_ns = len(requests), len(actions), searched_ns
    outcome.ns = cpu_ns if is_timed else None
    return outcome


def _act(policy: LoadedPolicy, graph: Graph, observations: Arrays, seeds: NDArray[np.int64]) -> Actions:
    """Actions as by default. With the same seeds, two policies sample equal actions as often as they are alike."""
    if not policy.samples:
        return graph.act(observations)
    return graph.act(observations, explore=True, rng=generators(seeds))


def _rows(request: MirroredRequest) -> int:
    return len(next(iter(request.observations.values())))


def _pair(request: MirroredRequest) -> tuple[str, int, int]:
    return request.champion.league, request.candidate.number, request.champion.number
