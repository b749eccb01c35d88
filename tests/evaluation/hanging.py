"""Tic-tac-toe whose first move never ends, or raises."""

from threading import Event
from typing import Any

from pettingzoo.classic import tictactoe_v3


class Hanging(tictactoe_v3.raw_env):
    def step(self, action: Any) -> None:
        Event().wait()


class Raising(tictactoe_v3.raw_env):
    def step(self, action: Any) -> None:
        raise ValueError("the board is gone")
