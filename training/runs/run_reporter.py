"""Reports a run's progress to the registry and to TensorBoard.

A thread sends reports, so that a slow or unreachable registry does not delay training. Reports that fail are sent
later, merged with newer ones. If the registry stays unreachable, the run's heartbeat stops for other readers; its
versions contain what was learned.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Mapping
from datetime import UTC, datetime
from math import isfinite
from types import TracebackType
from typing import Any, Self

from ray.tune.experiment import Trial

from league.errors import LeagueError, one_line
from league.registry.registry import Registry
from league.registry.storage.rows import RunPoint, RunState
from training.rllib_compat import TensorBoardWriter
from training.runs.run_directory import RunDirectory

RUN_GROUP = "run"
"""The TensorBoard group of metrics that belong to no policy."""
TUNE_ITEMS = {"timesteps_total", "timesteps_since_restore", "training_iteration", "iterations_since_restore"} | {
    "time_this_iter_s", "time_total_s", "time_since_restore", "timestamp", "pid",
}  # fmt: skip


class TensorBoard(TensorBoardWriter):
    """Writes training metrics grouped by policy, and flushes after every report."""

    def log_trial_result(self, _: int, trial: Trial, result: dict[str, Any]) -> None:
        curves = {tag(name): value for name, value in result.items() if is_metric(name, value)}
        self.write(trial, curves, result["timesteps_total"])


def tag(curve: str) -> str:
    """Return a metric's name in TensorBoard: `return` → `run/return`, `shared/kl` → `shared/kl`."""
    return curve if "/" in curve else f"{RUN_GROUP}/{curve}"


def is_metric(name: str, value: Any) -> bool:
    """Return whether an item of a result is a finite number other than Tune's own fields."""
    return isinstance(value, int | float) and not isinstance(value, bool) and isfinite(value) and name not in TUNE_ITEMS


logger = logging.getLogger("policy_league")
HEARTBEAT_SECONDS = 5.0
"""Maximum interval between heartbeats, in seconds: far less than `league.registry.storage.rows.HEARTBEAT_TIMEOUT`."""
FINAL_REPORT_SECONDS = 10.0
"""How long an ending driver waits for the registry, in seconds."""
RETRY_SECONDS = 0.5
"""Seconds between attempts to send the final report."""
DIGITS = 6
"""Significant digits of stored values."""
AGENT_PREFIX, AGENT_RETURN = "agents/", "/return"
"""The only metrics of single agents that are reported: in self-play between rivals, the mean return is always 0."""
MAX_AGENTS = 8
"""With more agents, their returns are not reported."""
POINT_FIELDS = {"steps", "seconds"}
"""Fields of a point besides its metrics."""


class RunReporter:
    """A context manager around a driver's work. How the block ends is reported as how the run ended."""

    def __init__(self, registry: Registry, run: RunDirectory) -> None:
        self._registry, self._run = registry, run
        self._start_steps = 0
        self._seconds = 0.0
        self._newest: RunPoint | None = None
        self._reported: RunPoint | None = None
        self._end: tuple[RunState, str | None] | None = None
        self._attempt = self._registered_attempt = 0
        self._is_over = False
        self._is_reachable = True
        self._lock = threading.Lock()
        self._has_news = threading.Event()
        self._thread = threading.Thread(target=self._report_all, name="run-reporter", daemon=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        if self._thread.is_alive():
            self._end = ending(error)
            self._has_news.set()
            self._thread.join(FINAL_REPORT_SECONDS)
            self._is_over = True

    def begin(self, steps: int, seconds: float) -> None:
        """Report an attempt that starts after `steps` of this run and `seconds` of training."""
        with self._lock:
            self._start_steps, self._seconds = steps, seconds
            self._newest = self._reported = None
            self._attempt += 1
        if not self._thread.is_alive():
            self._thread.start()

    def report(self, metrics: Mapping[str, Any]) -> None:
        """Report a trial's latest metrics. Reports that arrive faster than the registry accepts them are merged."""
        names = [name for name, value in metrics.items() if is_metric(name, value) and name not in POINT_FIELDS]
        returns = [name for name in names if name.startswith(AGENT_PREFIX) and name.endswith(AGENT_RETURN)]
        common = [name for name in names if not name.startswith(AGENT_PREFIX)]
        reported = common + returns if len(returns) <= MAX_AGENTS else common
        curves = {name: float(f"{metrics[name]:.{DIGITS}g}") for name in reported}
        with self._lock:
            if self._newest is not None and self._newest is not self._reported:
                curves = self._newest.curves | curves
            league, steps = self._run.record.config.league, int(metrics["steps"])
            self._newest = RunPoint(league, self._run.id, steps, curves, datetime.now(UTC))
            self._seconds = float(metrics["seconds"])
        self._has_news.set()

    def _report_all(self) -> None:
        league, run = self._run.record.config.league, self._run.id
        while not self._is_over:
            end = self._end  # read first, so that everything before the end is reported
            try:
                if self._registered_attempt != (attempt := self._attempt):
                    self._begin()
                    self._registered_attempt = attempt
                with self._lock:
                    point, seconds = self._newest, self._seconds
                self._registry.runs.record(league, run, None if point is self._reported else point, seconds)
                self._reported = point
                if end is not None:
                    self._registry.runs.end(league, run, *end)
                    return
                self._is_reachable = True
            except Exception as error:  # reporting must never end a run
                if self._is_reachable:
                    logger.warning("cannot report training run %s to the registry; training continues: %s", run, error)
                self._is_reachable = False
            self._has_news.wait(HEARTBEAT_SECONDS if end is None else RETRY_SECONDS)
            self._has_news.clear()

    def _begin(self) -> None:
        config, training = self._run.record.config, self._run.record.config.training
        self._registry.runs.begin(
            config.league,
            self._run.id,
            algorithm=training.algorithm,
            settings=training.model_dump(mode="json", by_alias=True),
            seed=training.seed,
            target=training.max_steps,
            parent=self._run.record.parent,
            exploits=self._run.record.exploits,
            steps=self._start_steps,
            record=self._run.record.model_dump(mode="json", by_alias=True, exclude={"complete"}),
        )


def ending(error: BaseException | None) -> tuple[RunState, str | None]:
    """Return how a run ended, by the exception that ended it, and why it failed."""
    match error:
        case None:
            return "ended", None
        case LeagueError():
            return "failed", str(error)
        case Exception():
            return "failed", one_line(error, with_type=True)[:500]
    return "stopped", None
