"""Tic-tac-toe whose first move blocks, raises, or ends the process."""

import os
import signal
from threading import Event
from typing import Any

from pettingzoo.classic import tictactoe_v3

from evaluation.matches.watchdog import TICK


class Hanging(tictactoe_v3.raw_env):
    def step(self, action: Any) -> None:
        Event().wait()


class Raising(tictactoe_v3.raw_env):
    def step(self, action: Any) -> None:
        raise ValueError("the board is gone")


class BlockingSignals(tictactoe_v3.raw_env):
    """Ignores signals, like native code that does not return."""

    def step(self, action: Any) -> None:
        signal.pthread_sigmask(signal.SIG_BLOCK, [TICK])
        Event().wait()


class Dying(tictactoe_v3.raw_env):
    def step(self, action: Any) -> None:
        os._exit(7)
