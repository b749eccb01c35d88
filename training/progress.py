"""A run's progress: a bar with return, steps/s and time to go in a terminal, plain lines elsewhere."""

import time
from collections.abc import Mapping
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, ProgressColumn, TaskProgressColumn, TextColumn
from rich.progress import Progress as Bars

from league.registry.rows import VersionRow
from league.training_config import TrainingSettings

SECONDS_PER_LINE = 10.0
MOST_POLICIES = 3
"""As many are shown by themselves; TensorBoard has all."""


class Progress:
    """Use as a context manager around the run. May be told of versions by another thread."""

    def __init__(self, console: Console, settings: TrainingSettings, policies: tuple[str, ...]) -> None:
        self._console = console
        self._settings = settings
        self._policies = policies
        self._bars = bars(console, TextColumn("{task.fields[pace]}"), TextColumn("{task.fields[doing]}"))
        self._bar = self._bars.add_task("Starting …", total=1.0, pace="", doing="")
        self._next_line = 0.0

    def __enter__(self) -> "Progress":
        if self._console.is_terminal:
            self._bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        # Where it was not started, it would print an empty line.
        if self._console.is_terminal:
            self._bars.stop()

    def update(self, metrics: Mapping[str, Any]) -> None:
        """Show a trial's newest metrics."""
        done = fraction(metrics, self._settings)
        steps, pace, doing = f"{metrics['steps']:,} steps", _pace(metrics, done), doings(metrics, self._policies)
        if self._console.is_terminal:
            self._bars.update(self._bar, completed=done, description=steps, pace=pace, doing=doing)
        elif time.monotonic() >= self._next_line or metrics.get("done"):
            self._next_line = time.monotonic() + SECONDS_PER_LINE
            self.say(f"{done:4.0%}  {steps}  {pace}  {doing}")

    def published(self, version: VersionRow) -> None:
        """Tell that a version is there."""
        parity = [policy.parity for policy in version.manifest.policies.values()]
        observations = sum(proof.observations for proof in parity)
        self.say(
            f"Published {version.ref} after {version.steps:,} steps: acts as trained on {observations:,} observations."
        )

    def say(self, sentence: str) -> None:
        """A sentence of its own, above the bar."""
        self._console.print(sentence, highlight=False, markup=False, soft_wrap=True)


def bars(console: Console, *columns: ProgressColumn) -> Bars:
    """A bar, how much of it is done, and `columns`."""
    return Bars(
        TextColumn("{task.description}"), BarColumn(24), TaskProgressColumn(), *columns, console=console, transient=True
    )


def fraction(metrics: Mapping[str, Any], settings: TrainingSettings) -> float:
    """How much of the budget is spent: of steps or of time, whichever is further."""
    spent = metrics["steps"] / settings.steps
    if settings.minutes is not None:
        spent = max(spent, metrics["seconds"] / (60 * settings.minutes))
    return min(spent, 1.0)


def doings(metrics: Mapping[str, Any], policies: tuple[str, ...]) -> str:
    """How the first few policies do."""
    shown = "; ".join(_doing(policy, metrics) for policy in policies[:MOST_POLICIES])
    more = len(policies) - MOST_POLICIES
    return f"{shown}; {more} more" if more > 0 else shown


def _doing(policy: str, metrics: Mapping[str, Any]) -> str:
    shown = (("return", "+.2f"), ("length", ".1f"), ("entropy", ".2f"))
    values = [f"{name} {metrics[key]:{form}}" for name, form in shown if (key := f"{policy}/{name}") in metrics]
    return f"{policy}: " + (", ".join(values) or "no episode is over yet")


def _pace(metrics: Mapping[str, Any], done: float) -> str:
    left = metrics["seconds"] * (1 - done) / done if done else 0.0
    speed = f"{metrics['steps_per_second']:,.0f} steps/s  " if "steps_per_second" in metrics else ""
    return f"{speed}{clock(metrics['seconds'])} trained, {clock(left)} to go"


def clock(seconds: float) -> str:
    """Minutes and seconds; hours where there are some."""
    minutes, rest = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
