"""Checks of constructor arguments. The stock environment reports those that are wrong."""

from collections.abc import Mapping
from typing import Any

from league.environments.vector.vector_env import UnsupportedArguments

COMMON = {"render_mode": None, "dynamic_rescaling": True, "benchmark_data": False}
NEIGHBORS = {"num_agent_neighbors": None, "num_landmark_neighbors": None}
CURRICULUM = {"curriculum": False, "terminate_on_success": False}
"""Arguments that are not implemented, with their defaults: of all environments, and of some."""


def reject_changed(arguments: Mapping[str, Any], defaults: Mapping[str, Any]) -> None:
    """Raise UnsupportedArguments unless these arguments exist and have their defaults."""
    for name, value in arguments.items():
        if name not in defaults or value != defaults[name]:
            raise UnsupportedArguments(f"{name}={value!r}")


def check_counts(least: int, **counts: Any) -> None:
    """Raise UnsupportedArguments unless these are integers of at least `least`."""
    for name, value in counts.items():
        if not isinstance(value, int) or value < least:
            raise UnsupportedArguments(f"{name}={value!r}")
