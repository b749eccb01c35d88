"""A verdict whose matches finish in random order, quickly when they are won and slowly when they are lost.

Workers are simulated: each takes the next chunk after it has finished one, and a chunk takes as long as its games, each
of which has a random duration that depends on its result. Finished chunks go through the same queue as those of real
workers (`evaluation.matches.tournament`), and the gate checks after each chunk, as in a nightly run.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Sequence

import numpy as np

from benchmarks.simulations.simulated_gates import EQUALS, stronger
from evaluation.gating.gate import SequentialMonitor, SequentialTest, decide_matches
from evaluation.matches.tournament import ReorderBuffer
from league.config.gate import GateConfig
from league.results.records import Game, Match

SETTINGS = GateConfig(elo1=60, max_blocks=600, nights=None)
CHUNK = 16
POINTS = ((0.0, 0.0), (0.5, 0.0), (0.5, 0.5), (1.0, 0.5), (1.0, 1.0))
SECONDS = {0.0: 9.0, 0.5: 3.0, 1.0: 1.0}
"""Mean duration of a game that is lost, drawn and won."""


def verdicts_of_shuffled_completion(orders: int) -> dict[tuple[str | None, int], int]:
    """(outcome, stopping block) → the number of orders of completion with this verdict."""
    rng = np.random.default_rng(6)
    cells = rng.choice(5, p=stronger(EQUALS["drawish"], 35), size=SETTINGS.max_blocks)
    matches = [_match(position, POINTS[cell]) for position, cell in enumerate(cells)]
    verdicts: dict[tuple[str | None, int], int] = {}
    for seed in range(orders):
        random = np.random.default_rng(seed)
        decision = _judged(matches, int(random.integers(1, 9)), random)
        verdicts[decision] = verdicts.get(decision, 0) + 1
    return verdicts


def _match(position: int, points: Sequence[float]) -> Match:
    games = tuple(Game((i, 1 - i), position, (), (), (p, 1 - p), (p, 1 - p)) for i, p in enumerate(points))
    return Match(f"s/{position}", "l", "s", position, ("l@2", "l@1"), position, "digest", games)


def _judged(matches: Sequence[Match], workers: int, random: np.random.Generator) -> tuple[str | None, int]:
    monitor, finished = SequentialMonitor(SequentialTest(SETTINGS, "l@2")), list[Match]()
    for chunk in _in_schedule_order(matches, workers, random):
        finished += chunk
        if monitor.is_over(finished):
            break
    decision = decide_matches(SequentialTest(SETTINGS, "l@2"), finished)
    return decision.outcome, decision.blocks


def _in_schedule_order(
    matches: Sequence[Match], workers: int, random: np.random.Generator
) -> Iterator[Sequence[Match]]:
    chunks = [matches[start : start + CHUNK] for start in range(0, len(matches), CHUNK)]
    queue: ReorderBuffer[Sequence[Match]] = ReorderBuffer()
    pending, running = enumerate(chunks), list[tuple[float, int]]()
    clock = 0.0
    while queue.due < len(chunks):
        while len(running) < workers and (following := next(pending, None)) is not None:
            heapq.heappush(running, (clock + _duration(following[1], random), following[0]))
        if (chunk := queue.take()) is not None:
            yield chunk
            continue
        clock, done = heapq.heappop(running)
        queue.put(done, chunks[done])


def _duration(chunk: Sequence[Match], random: np.random.Generator) -> float:
    means = [SECONDS[game.scores[0]] for match in chunk for game in match.games if game.scores[0] is not None]
    return float(random.exponential(means).sum())
