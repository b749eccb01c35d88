"""Runs one queued evaluation to its end, in a process that is its own Ray driver and therefore its own Ray job.

    python -m evaluation.service.evaluation_job \
        '{"evaluation": 12, "league": "chess", "runner": "…", "workers": 1, "address": null}'

All output goes to the registry. The process can die at any time; another one resumes from the ledger. When the
evaluation service ends, standard input closes, and the process releases its evaluation and exits.
"""

from __future__ import annotations

import json
import logging
import os
import sys
import threading
from contextlib import suppress
from typing import Any, Self

from ray.exceptions import RayError

from evaluation.documents import EvaluationReport, Progress
from evaluation.gating.evidence import VerdictReport
from evaluation.gating.nightly import NightlyListener, NightlyReport, nightly
from evaluation.matches.tournament import evaluate
from evaluation.schedules.tournament_plan import Budget
from evaluation.service.evaluation_supervisor import EvaluationJobOptions
from league.errors import LeagueError, StorageError, one_line, to_document
from league.ray_cluster import join, ray_session
from league.registry.registry import Registry
from league.registry.storage.rows import EvaluationRow
from league.service_requests import EvaluationRequest, NightlyRequest, TournamentRequest
from league.settings import Storage
from league.subprocesses import exit_with_parent, lower_priority

logger = logging.getLogger("policy_league")
HEARTBEAT_INTERVAL = 1.0
"""Seconds between two heartbeats, far below `league.registry.evaluations.HEARTBEAT_TIMEOUT`."""


class EvaluationStopped(Exception):
    """A stop of this evaluation was requested."""


def run_evaluation(options: EvaluationJobOptions, registry: Registry) -> None:
    """Run an evaluation and record its result or error.

    Raises StorageError and RayError without recording anything. Another process then resumes the evaluation.
    """
    with Heartbeat(registry, options) as heartbeat:
        try:
            evaluation = registry.evaluations.get(options.league, options.evaluation)
            report = _report(evaluation, registry, options.workers, heartbeat.listen)
        except EvaluationStopped:
            heartbeat.finish("stopped")
        except (StorageError, RayError):
            raise
        except LeagueError as error:
            heartbeat.finish("failed", error=to_document(error))
        except Exception as error:  # of an environment, or a bug: a retry would fail as well
            logger.exception("evaluation %d failed", options.evaluation)
            message = one_line(error, with_type=True)[:500]
            heartbeat.finish("failed", error={"code": "internal_error", "message": message})
        else:
            heartbeat.finish("done", result=report.to_json())


def _report(
    evaluation: EvaluationRow, registry: Registry, workers: int, listener: NightlyListener
) -> EvaluationReport | NightlyReport:
    """Dispatch the stored request.

    workers: processes that play matches. With one, it is this process; with more, they are Ray tasks.
    """
    tasks = workers if workers > 1 else 0
    match EvaluationRequest.model_validate_json(json.dumps(evaluation.request)).root:
        case TournamentRequest() as request:
            return evaluate(
                evaluation.league,
                request.contestants,
                registry=registry,
                schedule=request.schedule,
                against=request.against,
                blocks=request.blocks,
                budget=Budget(request.games, request.minutes, request.precision),
                seed=request.seed,
                workers=tasks,
                listener=listener,
            )
        case NightlyRequest():
            config = registry.leagues.get(evaluation.league).config
            return nightly(config, registry=registry, workers=tasks, listener=listener)


class Heartbeat(threading.Thread):
    """Writes heartbeats and progress to the registry in a thread, and reads stop requests from it."""

    def __init__(self, registry: Registry, options: EvaluationJobOptions) -> None:
        super().__init__(name="heartbeat", daemon=True)
        self._registry, self._options = registry, options
        self._progress: dict[str, Any] | None = None
        self._stop_requested = False
        self._is_over = threading.Event()

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._is_over.set()
        self.join()

    def listen(self, event: Progress | VerdictReport) -> None:
        """Listener of the evaluation. Raises EvaluationStopped."""
        if isinstance(event, Progress):
            self._progress = event.to_json()
        if self._stop_requested:
            raise EvaluationStopped

    def finish(self, state: Any, **outcome: Any) -> None:
        """Record the final state of the evaluation."""
        options = self._options
        self._registry.evaluations.finish(options.evaluation, options.runner, state, progress=self._progress, **outcome)

    def run(self) -> None:
        """Write heartbeats until the context ends."""
        options = self._options
        while not self._is_over.wait(HEARTBEAT_INTERVAL):
            try:
                row = self._registry.evaluations.heartbeat(options.evaluation, options.runner, self._progress)
            except StorageError as error:
                logger.error("no heartbeat of evaluation %d could be written: %s", options.evaluation, error)
                continue
            if row.runner != options.runner:
                os._exit(1)  # the claim expired, and another process has taken over
            self._stop_requested = row.stop_at is not None


def _release(options: EvaluationJobOptions, registry: Registry) -> None:
    with suppress(LeagueError):
        registry.evaluations.release(options.evaluation, options.runner)


def main() -> None:
    """Run the evaluation given on the command line."""
    options = EvaluationJobOptions(**json.loads(sys.argv[1]))
    lower_priority()
    registry = Registry.open(Storage.from_environment(), create=False)
    exit_with_parent(lambda: _release(options, registry))
    with ray_session():
        if options.address is not None:
            # Connect as a job: everything it starts ends with this process. Tasks get its import path and low priority.
            runtime_env: dict[str, Any] = {
                "worker_process_setup_hook": "league.subprocesses.lower_priority",
                "env_vars": {"PYTHONPATH": os.environ.get("PYTHONPATH", "")},
            }
            join(options.address, namespace="evaluations", runtime_env=runtime_env if options.workers > 1 else None)
        run_evaluation(options, registry)


if __name__ == "__main__":
    main()
