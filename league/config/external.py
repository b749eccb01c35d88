"""The section `environment.external`: a game that is no Python object but a simulator, which connects and plays."""

import re
from typing import Annotated

from pydantic import Field, PositiveFloat, field_validator

from league.config.base import Part
from league.interface import AgentInterface

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9 ._+-]{0,63}")


class ExternalConfig(Part):
    """What a league knows of a game that runs in simulators."""

    simulator: str
    """Name of the simulator, which it sends when it connects."""
    version: str
    """Version of the simulator, which it sends, too. It identifies the rules of the game: results of different versions
    are never combined. Change it with the rules."""
    agents: dict[Annotated[str, Field(min_length=1, max_length=64)], AgentInterface] = Field(
        min_length=1, max_length=1000
    )
    """Agent → its spaces, `observation` and `action`."""
    hidden_information: bool
    """Whether observations hide parts of the state from an opponent."""
    simultaneous: bool = False
    """Whether agents of several sides act at once, without seeing the actions of the others."""
    deterministic: bool = False
    """Whether a seed and the actions determine an episode, so that `league verify` can repeat it."""
    answer_seconds: PositiveFloat = 60.0
    """Time for a simulator to report after an action. Its connection is closed after it, and its episodes are lost."""

    @field_validator("simulator", "version")
    @classmethod
    def _is_name(cls, value: str) -> str:
        if not NAME.fullmatch(value):
            raise ValueError("expected 1 to 64 letters, digits, spaces, `.`, `_`, `+` and `-`")
        return value
