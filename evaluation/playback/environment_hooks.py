"""What an environment declares for the people who play it: a clickable board, keys, colours, and views of agents.

Its `metadata` may contain:

    board           a grid of actions in rows, as the picture shows it; None where no action is: [[0, 1], [2, None]]
    board_area      where the grid is: left, top, right and bottom as shares of the picture's width and height
    action_keys     key, as `KeyboardEvent.key` names it → action: {"ArrowUp": 0, "q": 4}
    agent_colors    agent → a colour name or #rrggbb: {"player_0": "red"}

A method `render_for(agent)` returns a picture, (height, width, 3) uint8, that contains only what the agent sees.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from league.config.environment import EnvironmentConfig
from league.config.validation_errors import describe_validation_error
from league.environments.building import build
from league.errors import EnvironmentMismatch

KNOWN: Mapping[str, Mapping[str, Any]] = {
    "connect_four_v3": {
        "board": [[0, 1, 2, 3, 4, 5, 6]],
        "board_area": (4 / 99, 4 / 86, 95 / 99, 82 / 86),
        "agent_colors": {"player_0": "#d63c4c", "player_1": "#5d6579"},
    },
    "tictactoe_v3": {
        "board": [[0, 3, 6], [1, 4, 7], [2, 5, 8]],
        "board_area": (0.02, 0.02, 0.99, 0.97),
        "agent_colors": {"player_1": "#6183e7", "player_2": "#f53a3a"},
    },
}
"""Declarations for environments of PettingZoo, by `metadata["name"]`."""

Board = tuple[tuple[int | None, ...], ...]
Area = tuple[float, float, float, float]


class Declarations(BaseModel):
    """The declarations in an environment's metadata."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    board: Board | None = None
    board_area: Area = (0, 0, 1, 1)
    action_keys: dict[str, int] = Field(default={})
    agent_colors: dict[str, str] = Field(default={})

    @field_validator("board")
    @classmethod
    def _is_a_grid(cls, board: Board | None) -> Board | None:
        if board is not None and (not board or not board[0] or len({len(row) for row in board}) > 1):
            raise ValueError("expected rows of equal length, such as [[0, 1], [2, 3]]")
        return board

    @field_validator("board_area")
    @classmethod
    def _is_in_the_picture(cls, area: Area) -> Area:
        left, top, right, bottom = area
        if not (0 <= left < right <= 1 and 0 <= top < bottom <= 1):
            raise ValueError("expected left < right and top < bottom between 0 and 1, such as [0.1, 0.1, 0.9, 0.9]")
        return area

    @field_validator("agent_colors")
    @classmethod
    def _are_colors(cls, colors: dict[str, str]) -> dict[str, str]:
        for agent, color in colors.items():
            if not re.fullmatch(r"#[0-9a-fA-F]{6}|[a-zA-Z]{3,30}", color):
                raise ValueError(f"{agent}: {color[:40]!r} is neither a colour name nor #rrggbb")
        return colors


@dataclass(frozen=True, slots=True)
class EnvironmentHooks:
    """What an environment offers for display.

    draws: whether it renders images. has_views: whether it renders what one agent sees.
    """

    draws: bool
    has_views: bool
    declared: Declarations


def environment_hooks(config: EnvironmentConfig) -> EnvironmentHooks:
    """Build the environment once to read its declarations. Raises EnvironmentMismatch if they are malformed."""
    with closing(build(config)) as env:
        metadata = getattr(env, "metadata", None) or {}
        has_views = callable(getattr(getattr(env, "unwrapped", env), "render_for", None))
    draws = "rgb_array" in (metadata.get("render_modes") or ())
    document = {**KNOWN.get(str(metadata.get("name")), {}), **metadata}
    try:
        declared = Declarations.model_validate(document)
    except ValidationError as error:
        fault = describe_validation_error(error, document)
        raise EnvironmentMismatch(f"metadata of {config.entry_point}: {fault}") from error
    return EnvironmentHooks(draws, draws and has_views, declared)
