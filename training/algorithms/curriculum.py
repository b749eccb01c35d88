"""The place of a run in its curriculum: which stage of `training.curriculum` it is in, and when it leaves it."""

from collections.abc import Mapping
from typing import Any

from league.config.training import StageConfig

STAGE = "curriculum/stage"
"""Metric: the number of the stage, from 1."""
UPDATES = 5
"""Updates in succession, of those that report the curves, in which a stage's values must be reached: the return of few
episodes is noisy."""


class Curriculum:
    """The current stage, from 0. Depends on the run's updates only, so that a resumed run continues exactly."""

    def __init__(self, stages: tuple[StageConfig, ...]) -> None:
        self._stages = stages
        self.restart(0)

    def restart(self, steps: int) -> None:
        """Begin the first stage. steps: actions of all agents so far, including parents'."""
        self.stage, self._began, self._updates = 0, steps, 0

    def advance(self, metrics: Mapping[str, float], steps: int) -> bool:
        """Add an update, and return whether another stage begins after it.

        metrics: of the update. steps: actions of all agents up to its end, including parents'.
        """
        if self.stage + 1 >= len(self._stages):
            return False
        stage = self._stages[self.stage]
        if stage.until and stage.until.keys() <= metrics.keys():
            reached = all(metrics[name] >= value for name, value in stage.until.items())
            self._updates = self._updates + 1 if reached else 0
        if self._updates < UPDATES and (stage.steps is None or steps - self._began < stage.steps):
            return False
        self.stage, self._began, self._updates = self.stage + 1, steps, 0
        return True

    def metrics(self) -> dict[str, float]:
        """Return the stage as a curve; empty without a curriculum."""
        return {STAGE: float(self.stage + 1)} if self._stages else {}

    def get_state(self) -> dict[str, Any]:
        """Return the state for a checkpoint."""
        return {"stage": self.stage, "began": self._began, "updates": self._updates}

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Continue where `get_state` was called."""
        self.stage, self._began, self._updates = state["stage"], state["began"], state["updates"]
