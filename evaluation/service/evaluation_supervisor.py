"""Runs queued evaluations in subprocesses and ends those that do not stop in time.

The registry holds the queue and the claims. Several evaluation services can therefore share it, and a restarted one
resumes what it left.
"""

from __future__ import annotations

import json
import logging
import secrets
import threading
from contextlib import suppress
from dataclasses import asdict, dataclass
from datetime import UTC, datetime, timedelta

from league.errors import LeagueError
from league.registry.registry import Registry
from league.subprocesses import Subprocess

logger = logging.getLogger("ray.serve.policy_league")
POLL_INTERVAL = 0.5
"""Seconds between two checks of the queue."""
STOP_TIMEOUT = timedelta(seconds=10)
"""Time for a job to stop before it is killed. A job checks for stop requests after each chunk of games."""


@dataclass(frozen=True, slots=True)
class EvaluationJobOptions:
    """Argument of an evaluation job.

    runner: name under which the job claimed the evaluation. address: Ray cluster to join, or None to start a local
    one if needed.
    """

    evaluation: int
    league: str
    runner: str
    workers: int
    address: str | None


@dataclass(frozen=True, slots=True)
class _Job:
    options: EvaluationJobOptions
    process: Subprocess


class EvaluationSupervisor(threading.Thread):
    """Polls the registry in a thread and runs up to `at_once` evaluations with `workers` processes each.

    address: Ray cluster that jobs join, or None to start a local one if needed.
    """

    def __init__(self, registry: Registry, *, workers: int = 1, at_once: int = 1, address: str | None = None) -> None:
        super().__init__(name="evaluation-supervisor", daemon=True)
        self._registry, self._address = registry, address
        self._workers, self._at_once = workers, at_once
        self._jobs: list[_Job] = []
        self._wake = threading.Event()
        self._is_closed = False

    def notify(self) -> None:
        """Check the queue now."""
        self._wake.set()

    def close(self) -> None:
        """Kill all jobs. Another evaluation service resumes their evaluations."""
        self._is_closed = True
        self._wake.set()
        self.join()
        for job in self._jobs:
            job.process.kill()
            with suppress(LeagueError):  # without the database, the missing heartbeat releases the evaluation
                self._release(job)

    def run(self) -> None:
        """Poll until `close`."""
        while not self._is_closed:
            try:
                self._check_jobs()
                self._start_jobs()
            except LeagueError as error:
                logger.error("evaluations cannot be supervised: %s", error)
            self._wake.wait(POLL_INTERVAL)
            self._wake.clear()

    def _check_jobs(self) -> None:
        """Release exited jobs and kill those that ignore a stop request."""
        for job in list(self._jobs):
            if not job.process.is_running:
                self._release(job)
                self._jobs.remove(job)
                continue
            stop_at = self._registry.evaluations.get(job.options.league, job.options.evaluation).stop_at
            if stop_at is not None and datetime.now(UTC) - stop_at > STOP_TIMEOUT:
                logger.error("evaluation %d did not stop in time: killing its process", job.options.evaluation)
                job.process.kill()

    def _release(self, job: _Job) -> None:
        if code := job.process.reap():
            logger.error("the process of evaluation %d exited with code %d", job.options.evaluation, code)
        self._registry.evaluations.release(job.options.evaluation, job.options.runner)

    def _start_jobs(self) -> None:
        while len(self._jobs) < self._at_once:
            name = secrets.token_hex(16)
            claimed = self._registry.evaluations.claim(name, self._workers)
            if claimed is None:
                return
            options = EvaluationJobOptions(claimed.id, claimed.league, name, self._workers, self._address)
            process = Subprocess("evaluation.service.evaluation_job", json.dumps(asdict(options)))
            self._jobs.append(_Job(options, process))
