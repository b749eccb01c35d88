"""Tic-tac-toe whose first move never ends."""

from threading import Event
from typing import Any

from pettingzoo.classic import tictactoe_v3


class Hanging(tictactoe_v3.raw_env):
    def step(self, action: Any) -> None:
        Event().wait()


env = Hanging
