"""An environment that fails on purpose, in the configured way, if an agent takes the action LIGHT at every step."""

from __future__ import annotations

import threading
import time
from collections import deque
from itertools import repeat
from typing import Any

import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv

STEPS = 4
LIGHT = 7
ACTIONS = 20


class Fuse(ParallelEnv):
    """Two players, `STEPS` steps, constant observations. It fails in the last step, or in the reset after it."""

    metadata = {"name": "fuse_v0", "render_modes": []}  # noqa: RUF012  PettingZoo declares it like this

    def __init__(self, ends: str, where: str) -> None:
        self.ends, self.where = ends, where
        self.possible_agents = ["left", "right"]
        self.render_mode = None
        self.lit = False

    def observation_space(self, agent: str) -> spaces.Space:
        return spaces.Box(0, 1, (2,), np.float32)

    def action_space(self, agent: str) -> spaces.Space:
        return spaces.Discrete(ACTIONS)

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        if self.lit and self.where == "reset":
            self._fail()
        self.agents, self.time = self.possible_agents[:], 0
        self.triggering = set(self.agents)
        return self._observations(), {agent: {} for agent in self.agents}

    def step(self, actions: dict[str, int]) -> Any:
        self.time += 1
        self.triggering &= {agent for agent, action in actions.items() if action == LIGHT}
        is_over = self.time == STEPS
        self.lit = is_over and bool(self.triggering)
        if self.lit and self.where == "step":
            self._fail()
        ended = dict.fromkeys(self.agents, is_over)
        result = self._observations(), dict.fromkeys(self.agents, 0.0), ended, dict.fromkeys(self.agents, False), {}
        self.agents = [] if is_over else self.agents
        return result

    def _observations(self) -> dict[str, np.ndarray]:
        return {agent: np.ones(2, np.float32) for agent in self.agents}

    def _fail(self) -> None:
        FAULTS[self.ends]()


def waits() -> None:
    """Wait for a lock that is never released."""
    lock = threading.Lock()
    lock.acquire()
    lock.acquire()


def spins() -> None:
    while True:
        pass


def swallows() -> None:
    while True:
        try:
            time.sleep(1000)
        except Exception:
            continue


def stalls() -> None:
    """Run native code that holds the GIL and ignores signals."""
    deque(repeat(None), maxlen=0)


def breaks() -> None:
    raise ValueError("the fuse has burnt down")


FAULTS = {fault.__name__: fault for fault in (waits, spins, swallows, stalls, breaks)}


def fuse(ends: str = "waits", where: str = "step") -> Fuse:
    """The entry point for configurations."""
    return Fuse(ends, where)
