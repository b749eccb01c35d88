"""Mirrors requests that the champion has answered to a candidate, and compares their actions.

    request → champion → response
                 ↘ bounded queue → thread: candidate → same action? latency? → counts

Callers are unaffected. The thread compares one request after the other, and pauses to stay within its share of a core;
requests that exceed it are dropped and counted. Runs are timed in CPU time, so that neither other requests nor waiting
for the GIL count as the candidate's latency, and those that take long are ended.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from queue import SimpleQueue
from random import random, randrange
from threading import Thread
from time import sleep, thread_time_ns
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from league.errors import one_line
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

PAUSE = 0.05
"""Seconds of a pause at least, in which requests are collected. Fewer wake-ups take less time from the event loop."""
SLICE = 0.005
"""Seconds of CPU time after which the thread pauses although requests wait."""
TOLERANCE = 0.01
"""Continuous actions are equal if they differ by less than this share of their range."""
MAX_WAITING_BYTES = 16 * 2**20
"""Maximum size of queued observations."""

MirrorFunction = Callable[[Arrays, Arrays | None, NDArray | None], None]
"""Takes the observations of a request, its recurrent state, and the champion's greedy actions, or None if they were
sampled."""


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


class MirroredRequest(NamedTuple):
    """A queued request."""

    shadow: LoadedVersion
    candidate: LoadedVersion
    """The shadow, or a member of it."""
    champion: LoadedPolicy
    observations: Arrays
    actions: NDArray | None
    size: int
    """Bytes of the observations."""
    counts: Tally


class Shadow:
    """Mirrors requests to candidates. Its public methods run on the event loop."""

    def __init__(self, slots: AliasSlots, traffic: TrafficSplit, settings: ServeSettings) -> None:
        self._slots = slots
        self._traffic = traffic
        self._settings = settings
        self._counts: dict[tuple[str, int, int], Tally] = {}
        self._queue = SimpleQueue[MirroredRequest | None]()
        # Each is changed by one thread.
        self._mirrored_bytes = self._compared_bytes = 0

    @property
    def waiting_bytes(self) -> int:
        """Bytes of the observations that are not yet compared."""
        return self._mirrored_bytes - self._compared_bytes

    def mirror_for(self, policy: LoadedPolicy) -> MirrorFunction | None:
        """The function that mirrors a request that `policy` answers; None if it is not mirrored."""
        portion = self._traffic.shadows.get(policy.league)
        if portion is None or (portion.share < 1 and random() >= portion.share):
            return None
        shadow = self._traffic.serving(self._traffic.shadows, policy.league)
        champion = self._slots.champion(policy.league)
        if shadow is None or champion is None or shadow is champion:
            return None
        if all(version.policies.get(policy.name) is not policy for version in (champion, *champion.members)):
            return None
        candidate = acting(shadow, ())
        if candidate.policies.get(policy.name) is policy:
            return None

        def mirror(observations: Arrays, state: Arrays | None, actions: NDArray | None) -> None:
            counts = self._counts.setdefault((policy.league, candidate.number, policy.number), Tally())
            if state is not None:  # it would be another network's
                counts.skipped += 1
                return
            size = sum(array.nbytes for array in observations.values())
            is_full = self._queue.qsize() >= self._settings.shadow_waiting
            if is_full or self.waiting_bytes + size > MAX_WAITING_BYTES:
                counts.dropped += 1
                return
            self._mirrored_bytes += size
            self._queue.put(MirroredRequest(shadow, candidate, policy, observations, actions, size, counts))

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
                list(counts.latency.counts),
                counts.latency.ns,
            )
            for pair, counts in sorted(self._counts.items())
        ]

    @contextmanager
    def comparing(self) -> Iterator[None]:
        """Compare mirrored requests while the context is active."""
        Thread(target=self._compare_all, name="shadow", daemon=True).start()
        try:
            yield
        finally:
            self._queue.put(None)

    def _compare_all(self) -> None:
        seconds = 0.0
        while (request := self._queue.get()) is not None:
            if self._traffic.serving(self._traffic.shadows, request.shadow.league) is request.shadow:
                seconds += _compare(request)
            else:  # Its runs may be slow, and those of another shadow wait.
                request.counts.dropped += 1
            self._compared_bytes += request.size
            if seconds >= SLICE or self._queue.empty():
                sleep(max(PAUSE, seconds * (1 / self._settings.shadow_load - 1)))
                seconds = 0.0


def _compare(request: MirroredRequest) -> float:
    """Run the candidate, and count the result. Returns seconds of CPU time."""
    champion, observations, expected, counts = request.champion, request.observations, request.actions, request.counts
    start, searched_ns = thread_time_ns(), 0
    try:
        candidate = request.candidate.policy(champion.name)
        rows = len(next(iter(observations.values())))
        seeds = randrange(2**62) + np.arange(rows)
        answer = _act(candidate, candidate.shadow_graph, observations, seeds)
        searched_ns = answer.ns if isinstance(answer, SearchedActions) else 0
        cpu_ns = thread_time_ns() - start + searched_ns
        # The champion's actions are recomputed if they were or are to be sampled.
        if champion.samples or expected is None:
            expected = _act(champion, champion.graph, observations, seeds).actions
        agreed = int(same(answer.actions, expected, candidate.manifest.action, TOLERANCE).sum())
    except Exception as error:  # any failure is counted against the candidate
        if not counts.failed:
            name = f"{request.candidate.league}@{request.candidate.number}"
            logger.error("%s failed to answer a mirrored request: %s", name, one_line(error, with_type=True))
        counts.failed += 1
    else:
        counts.latency.add(cpu_ns)
        counts.agreed += agreed
        counts.observations += rows
        counts.requests += 1
    return (thread_time_ns() - start + searched_ns) / 1e9


def _act(policy: LoadedPolicy, graph: Graph, observations: Arrays, seeds: NDArray[np.int64]) -> Actions:
    """Actions as by default. With the same seeds, two policies sample equal actions as often as they are alike."""
    if not policy.samples:
        return graph.act(observations)
    return graph.act(observations, explore=True, rng=generators(seeds))
