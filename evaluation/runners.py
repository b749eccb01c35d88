"""The processes that play what was asked of the service: started, watched, and ended if they do not stop when told.

What there is to play, and who plays it, is in the registry. So several studios do not get in each other's way, and one
that starts anew goes on with what another has left.
"""

from __future__ import annotations

import json
import logging
import secrets
import subprocess
import threading
from contextlib import suppress
from dataclasses import asdict, dataclass
from datetime import UTC, datetime, timedelta

from evaluation import children
from league.errors import LeagueError
from league.registry.registry import Registry

logger = logging.getLogger("ray.serve.policy_league")
LOOK = 0.5
"""Seconds between two looks at what there is to do."""
GRACE = timedelta(seconds=10)
"""How long a runner may take to stop: it looks up after each chunk of games."""


@dataclass(frozen=True, slots=True)
class Order:
    """What a runner is told. `address`: of the Ray to join; None: it starts one if it needs it."""

    evaluation: int
    league: str
    runner: str
    workers: int
    address: str | None


@dataclass(frozen=True, slots=True)
class _Runner:
    order: Order
    process: subprocess.Popen[bytes]


class Runners:
    """Plays what the registry has, `at_once` evaluations at a time with `workers` processes each, in a thread.

    address: of the Ray that runners join; None: they start one if they need it.
    """

    def __init__(self, registry: Registry, *, workers: int = 1, at_once: int = 1, address: str | None = None) -> None:
        self._registry = registry
        self._workers = workers
        self._at_once = at_once
        self._address = address
        self._runners: list[_Runner] = []
        self._has_news = threading.Event()
        self._is_over = False
        self._thread = threading.Thread(target=self._run, name="runners", daemon=True)

    def start(self) -> None:
        """Begin to look."""
        self._thread.start()

    @property
    def are_watched(self) -> bool:
        """Whether somebody looks after them."""
        return self._thread.is_alive()

    def look(self) -> None:
        """Look soon: there is something new."""
        self._has_news.set()

    def close(self) -> None:
        """End all runners; what they played waits for another studio."""
        self._is_over = True
        self._has_news.set()
        self._thread.join()
        for runner in self._runners:
            runner.process.kill()
            with suppress(LeagueError):  # without the database it is found by its silence
                self._bury(runner)

    def _run(self) -> None:
        while not self._is_over:
            try:
                self._watch()
                self._begin()
            except LeagueError as error:
                logger.error("evaluations cannot be followed: %s", error)
            self._has_news.wait(LOOK)
            self._has_news.clear()

    def _watch(self) -> None:
        """Bury the dead, end those that do not stop."""
        for runner in list(self._runners):
            if runner.process.poll() is not None:
                self._bury(runner)
                self._runners.remove(runner)
            elif self._is_overdue(runner.order):
                logger.error("evaluation %d does not stop: its process is ended", runner.order.evaluation)
                runner.process.kill()

    def _is_overdue(self, order: Order) -> bool:
        asked = self._registry.evaluation(order.league, order.evaluation).stop_at
        return asked is not None and datetime.now(UTC) - asked > GRACE

    def _bury(self, runner: _Runner) -> None:
        if code := children.bury(runner.process):
            logger.error("the process of evaluation %d ended with code %d", runner.order.evaluation, code)
        self._registry.release_evaluation(runner.order.evaluation, runner.order.runner)

    def _begin(self) -> None:
        while len(self._runners) < self._at_once:
            name = secrets.token_hex(16)
            claimed = self._registry.claim_evaluation(name, self._workers)
            if claimed is None:
                return
            order = Order(claimed.id, claimed.league, name, self._workers, self._address)
            self._runners.append(_Runner(order, children.start("evaluation.job", json.dumps(asdict(order)))))
