"""Says during a run where simulators connect, and how many of them are connected."""

import time
from collections.abc import Callable
from typing import Any

from ray import tune

from league.errors import StorageError
from league.registry.registry import Registry
from training.rllib_compat import NotPickled

POLL = 0.5
"""Seconds."""


class SimulatorWatch(NotPickled, tune.Callback):
    """Watches the gateways of a league during one attempt. say: prints a line. machines: of the cluster."""

    def __init__(self, registry: Registry, league: str, say: Callable[[str], None], machines: int = 1) -> None:
        self._registry, self._league, self._say, self._machines = registry, league, say, machines
        self._urls: set[str] = set()
        self._simulators: int | None = None
        self._next_look = 0.0

    def on_step_begin(self, **_: Any) -> None:
        """Called by Tune, many times per second."""
        if time.monotonic() < self._next_look:
            return
        self._next_look = time.monotonic() + POLL
        try:
            gateways = [gateway for gateway in self._registry.gateways.open(self._league) if not gateway.is_evaluation]
        except StorageError:
            return
        for gateway in gateways:
            if gateway.url not in self._urls:
                self._urls.add(gateway.url)
                self._say(
                    f"Simulators of league {self._league} connect to the server, or here: {gateway.url} with the key"
                    f" {gateway.token}"
                )
                if self._machines > 1:
                    self._say(
                        f"The cluster has {self._machines} machines, and only the one of the run's runner reaches this"
                        " address, which is on loopback: simulators elsewhere wait. Run a replica of the server on each"
                        " machine, or train on the machine of the server without a cluster."
                    )
        if not gateways or (simulators := sum(gateway.simulators for gateway in gateways)) == self._simulators:
            return
        if simulators:
            self._say(f"{simulators} simulator{'s are' if simulators > 1 else ' is'} connected.")
        else:
            self._say("The run waits for simulators. Its minutes do not pass.")
        self._simulators = simulators
