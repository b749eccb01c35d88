"""Tells the registry where a gateway is, so that the server and the command line can send simulators there."""

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

from league.errors import LeagueError, one_line
from league.registry.registry import Registry
from league.registry.storage.rows import Gateway
from league.settings import Storage

logger = logging.getLogger(__name__)

INTERVAL, LONGEST_INTERVAL = 0.25, 2.0
"""Seconds between two looks at the gateway, and between two announcements if nothing has changed."""
IDLE = 1.0
"""Seconds without an episode after which simulators go elsewhere."""


class Needs(NamedTuple):
    """What a process needs. simulators: how many are connected. waiting: episodes that wait for one. episodes: all."""

    simulators: int
    waiting: int
    episodes: int


class Advertisement:
    """Announces a gateway while episodes are needed, in a thread, because the database may be slow."""

    def __init__(
        self, storage: Storage, gateway: Gateway, needs: Callable[[], Needs], dismiss: Callable[[], None]
    ) -> None:
        """needs: returns what is needed now. dismiss: lets all simulators go.

        Raises LeagueError if the league does not exist.
        """
        self._registry = Registry.open(storage, create=False)
        self._gateway, self._needs, self._dismiss = gateway, needs, dismiss
        self.should_yield = False
        """Whether an evaluation waits for a simulator, and has none."""
        self._is_announced = False
        self._is_closed = threading.Event()
        self._thread = threading.Thread(target=self._repeat, name="advertisement", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Withdraw the announcement."""
        self._is_closed.set()
        self._thread.join()
        self._withdraw()
        self._registry.close()

    def _repeat(self) -> None:
        announced_at = needed_at = time.monotonic()
        while not self._is_closed.wait(INTERVAL):
            needs, moment = self._needs(), time.monotonic()
            if needs.episodes:
                needed_at, announced = moment, self._gateway
                gateway = replace(announced, simulators=needs.simulators, waiting=needs.waiting)
                is_other = gateway.simulators != announced.simulators or bool(gateway.waiting) != bool(
                    announced.waiting
                )
                if is_other or not self._is_announced or moment - announced_at >= LONGEST_INTERVAL:
                    announced_at, self._gateway = moment, gateway
                    self._announce()
            elif moment - needed_at >= IDLE:
                if self._is_announced:
                    self._withdraw()
                if needs.simulators:
                    self._dismiss()

    def _announce(self) -> None:
        try:
            self._registry.gateways.announce(self._gateway)
            self._is_announced = True
            if not self._gateway.is_evaluation:
                gateways = self._registry.gateways.open(self._gateway.league)
                self.should_yield = any(
                    gateway.is_evaluation and gateway.waiting and not gateway.simulators for gateway in gateways
                )
        except LeagueError as error:
            logger.warning("The gateway cannot be announced: %s", one_line(error))

    def _withdraw(self) -> None:
        try:
            self._registry.gateways.close(self._gateway)
        except LeagueError as error:  # the announcement expires
            logger.warning("The gateway cannot be withdrawn: %s", one_line(error))
        self._is_announced = False
