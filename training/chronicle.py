"""What the registry is told of a run while it is on: that it lives, its curves, and how it ended.

A thread tells it, so that a registry which is slow or gone holds no training up. What cannot be told is told later with
what came meanwhile, or never: then the run falls silent, for others. What was learned is in its versions.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Mapping
from datetime import UTC, datetime
from types import TracebackType
from typing import Any, Self

from league.errors import LeagueError
from league.registry.registry import Registry
from league.registry.rows import RunPoint, RunState
from training.runs import Run
from training.tensorboard import is_curve

logger = logging.getLogger("policy_league")
BEAT = 5.0
"""Seconds between two signs of life, at most: far less than `league.registry.runs.SILENT`."""
LAST_WORDS = 10.0
"""Seconds that a driver which ends waits for the registry."""
AGAIN = 0.5
"""Seconds until they are tried again."""
DIGITS = 6
"""Of the numbers that are kept: a curve is looked at."""
OF_AGENTS = "agents/"
"""Curves of single agents, of which there may be many, are not told."""
OF_POINTS = {"steps", "seconds"}
"""What is told of a point beside its curves."""


class Chronicle:
    """Use as a context manager around a driver's work; how that ends is how the run ended."""

    def __init__(self, registry: Registry, run: Run) -> None:
        self._registry, self._run = registry, run
        self._begins_at = 0
        self._seconds = 0.0
        self._newest: RunPoint | None = None
        self._told: RunPoint | None = None
        self._end: tuple[RunState, str | None] | None = None
        self._is_begun = self._is_over = False
        self._is_heard = True
        self._lock = threading.Lock()
        self._has_news = threading.Event()
        self._thread = threading.Thread(target=self._tell_all, name="chronicle", daemon=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        if self._thread.is_alive():
            self._end = _ending(error)
            self._has_news.set()
            self._thread.join(LAST_WORDS)
            self._is_over = True

    def begin(self, steps: int, seconds: float) -> None:
        """Training begins, or goes on, after so many steps of this run and seconds of training."""
        self._begins_at, self._seconds = steps, seconds
        self._thread.start()

    def tell(self, metrics: Mapping[str, Any]) -> None:
        """A trial's newest metrics. Those that come faster than the registry takes them are told as one."""
        curves = {name: _rounded(value) for name, value in metrics.items() if _is_told(name, value)}
        with self._lock:
            if self._newest is not None and self._newest is not self._told:
                curves = self._newest.curves | curves
            self._newest = RunPoint(int(metrics["steps"]), curves, datetime.now(UTC))
            self._seconds = float(metrics["seconds"])
        self._has_news.set()

    def _tell_all(self) -> None:
        while not self._is_over:
            end = self._end  # before the rest: what came until then is told first
            try:
                self._tell_newest()
                if end is not None:
                    self._registry.end_run(self._run.record.config.league, self._run.id, *end)
                    return
                self._is_heard = True
            except Exception as error:  # of whatever kind: a run is worth more than what is told of it
                if self._is_heard:
                    logger.warning(
                        "the registry hears nothing of training run %s, which goes on: %s", self._run.id, error
                    )
                self._is_heard = False
            self._has_news.wait(BEAT if end is None else AGAIN)
            self._has_news.clear()

    def _tell_newest(self) -> None:
        league = self._run.record.config.league
        if not self._is_begun:
            self._begin()
        with self._lock:
            point, seconds = self._newest, self._seconds
        self._registry.record_point(league, self._run.id, None if point is self._told else point, seconds)
        self._told = point

    def _begin(self) -> None:
        config, training = self._run.record.config, self._run.record.config.training
        self._registry.begin_run(
            config.league,
            self._run.id,
            algorithm=training.algorithm,
            settings=training.model_dump(mode="json", by_alias=True),
            seed=training.seed,
            target=training.steps,
            parent=self._run.record.parent,
            steps=self._begins_at,
        )
        self._is_begun = True


def _ending(error: BaseException | None) -> tuple[RunState, str | None]:
    match error:
        case None:
            return "ended", None
        case LeagueError():
            return "failed", str(error)
        case Exception():
            return "failed", " ".join(f"{type(error).__name__}: {error}".split())[:500]
    return "stopped", None


def _is_told(name: str, value: Any) -> bool:
    return is_curve(name, value) and not name.startswith(OF_AGENTS) and name not in OF_POINTS


def _rounded(value: float) -> float:
    return float(f"{value:.{DIGITS}g}")
