"""Tic-tac-toe that declares a board, keys and colours, and whose pictures of one colour show who sees what."""

from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pettingzoo.classic import tictactoe_v3

EVERYTHING = 240
VIEWS = {"player_1": 60, "player_2": 120}
"""Brightness of the pictures."""


def picture(brightness: int) -> NDArray[np.uint8]:
    return np.full((300, 300, 3), brightness, np.uint8)


class Open(tictactoe_v3.raw_env):
    metadata: ClassVar[dict[str, Any]] = {"name": "declaring", "render_modes": ["rgb_array"]}

    def render(self) -> NDArray[np.uint8]:
        return picture(EVERYTHING)


class Revealing(Open):
    metadata: ClassVar[dict[str, Any]] = {**Open.metadata, "hidden_information": True}


class Declaring(Revealing):
    metadata: ClassVar[dict[str, Any]] = {
        **Revealing.metadata,
        "board": [[0, None], [1, 2]],
        "action_keys": {"d": 4, "x": 99},
        "agent_colors": {"player_1": "red"},
    }

    def render_for(self, agent: str) -> NDArray[np.uint8]:
        return picture(VIEWS[agent])


class Malformed(Open):
    """The metadata belongs to the instance and depends on arguments."""

    def __init__(self, render_mode: str | None = None, **declared: Any) -> None:
        super().__init__(render_mode)
        self.metadata = {**self.metadata, **declared}  # type: ignore[misc]
