"""One evaluation that was asked of the service, played to its end by this process: a driver, and so a job, of Ray.

    python -m evaluation.job '{"evaluation": 12, "league": "chess", "runner": "…", "workers": 1, "address": null}'

All that others see of it is in the registry. This process may die at any point: another goes on where the ledger is.
Its standard input is its studio's life: when that closes, it puts the evaluation back and ends.
"""

from __future__ import annotations

import json
import logging
import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import TracebackType
from typing import Any, Self

import ray
from ray.exceptions import RayError

from evaluation.budget import Budget
from evaluation.children import end_with_studio, step_aside
from evaluation.nightly import nightly
from evaluation.report import EvaluationReport, Listener, NightReport, Progress, VerdictReport
from evaluation.runners import Order
from evaluation.tournament import evaluate
from league.errors import LeagueError, StorageError
from league.evaluations import Asked, Night, Tournament
from league.registry.registry import Registry
from league.registry.rows import EvaluationRow
from league.settings import Storage

logger = logging.getLogger("policy_league")
BEAT = 1.0
"""Seconds between two signs of life: far less than `league.registry.evaluations.SILENT`."""


class Stopped(Exception):
    """Somebody wants no more of this evaluation."""


def play(order: Order, registry: Registry) -> None:
    """Play an evaluation and record how it ended.

    Raises StorageError and RayError: then nothing is recorded, and it is played on by another process.
    """
    with Pulse(registry, order) as pulse:
        try:
            report = _report(registry.evaluation(order.league, order.evaluation), registry, order.workers, pulse.tell)
        except Stopped:
            pulse.finish("stopped")
        except (StorageError, RayError):
            raise
        except LeagueError as error:
            pulse.finish("failed", error={"code": error.code, "message": str(error)})
        except Exception as error:  # of an environment, or a bug: it would come again
            logger.exception("evaluation %d failed", order.evaluation)
            message = " ".join(f"{type(error).__name__}: {error}".split())[:500]
            pulse.finish("failed", error={"code": "internal_error", "message": message})
        else:
            pulse.finish("done", result=report.to_json())


def _report(
    evaluation: EvaluationRow, registry: Registry, workers: int, listener: Listener
) -> EvaluationReport | NightReport:
    """Do what was asked: the one place where a request becomes a call.

    workers: processes that play. One is this one; of several, tasks of Ray, of which `run` has one more under way than
    it is told.
    """
    tasks = workers - 1
    match Asked.model_validate_json(json.dumps(evaluation.asked)).root:
        case Tournament() as asked:
            return evaluate(
                evaluation.league,
                asked.contestants,
                registry=registry,
                schedule=asked.schedule,
                against=asked.against,
                blocks=asked.blocks,
                budget=Budget(asked.games, asked.minutes, asked.precision),
                seed=asked.seed,
                workers=tasks,
                listener=listener,
            )
        case Night():
            config = registry.league(evaluation.league).config
            return nightly(config, registry=registry, workers=tasks, listener=listener)


class Pulse:
    """Says again and again that this process lives, and how far it is; hears whether it shall stop."""

    def __init__(self, registry: Registry, order: Order) -> None:
        self._registry = registry
        self._order = order
        self._progress: dict[str, Any] | None = None
        self._is_to_stop = False
        self._is_over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="pulse", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self._is_over.set()
        self._thread.join()

    def tell(self, event: Progress | VerdictReport) -> None:
        """A listener of games. Raises Stopped."""
        if isinstance(event, Progress):
            self._progress = event.to_json()
        if self._is_to_stop:
            raise Stopped

    def finish(self, state: Any, **outcome: Any) -> None:
        """Record how the evaluation ended."""
        order = self._order
        self._registry.finish_evaluation(order.evaluation, order.runner, state, progress=self._progress, **outcome)

    def _run(self) -> None:
        while not self._is_over.wait(BEAT):
            try:
                row = self._registry.beat_evaluation(self._order.evaluation, self._order.runner, self._progress)
            except StorageError as error:
                logger.error("the registry hears nothing of evaluation %d: %s", self._order.evaluation, error)
                continue
            if row.runner != self._order.runner:
                os._exit(1)  # this process was given up, and another plays
            self._is_to_stop = row.stop_at is not None


@contextmanager
def _joined(order: Order) -> Iterator[None]:
    """Be a job of the Ray at `order.address`: what that starts for it ends with this process."""
    if order.address is not None:
        ray.init(
            address=order.address,
            namespace="evaluations",
            log_to_driver=False,
            logging_level=logging.ERROR,
            runtime_env=_aside() if order.workers > 1 else None,
        )
    try:
        yield
    finally:
        if ray.is_initialized():
            ray.shutdown()


def _aside() -> dict[str, Any]:
    """The environment of tasks: they find the modules that this process finds, and give way as it does."""
    return {
        "worker_process_setup_hook": "evaluation.children.step_aside",
        "env_vars": {"PYTHONPATH": os.environ.get("PYTHONPATH", "")},
    }


def _put_back(order: Order, registry: Registry) -> None:
    with suppress(LeagueError):
        registry.release_evaluation(order.evaluation, order.runner)


def main() -> None:
    """Carry out a studio's order."""
    order = Order(**json.loads(sys.argv[1]))
    step_aside()
    registry = Registry.open(Storage.from_environment(), create=False)
    end_with_studio(lambda: _put_back(order, registry))
    with _joined(order):
        play(order, registry)


if __name__ == "__main__":
    main()
