"""A run's progress: a live line in a terminal, plain lines elsewhere."""

import time
from collections.abc import Mapping
from typing import Any

from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from league.config import PPOConfig
from league.registry.rows import VersionRow

SECONDS_PER_LINE = 10.0


class Progress:
    """Use as a context manager around the run. May be told of versions by another thread."""

    def __init__(self, console: Console, settings: PPOConfig, policies: tuple[str, ...]) -> None:
        self._console = console
        self._settings = settings
        self._policies = policies
        self._live = Live(Text("Starting …"), console=console, transient=True) if console.is_terminal else None
        self._next_line = 0.0

    def __enter__(self) -> "Progress":
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live is not None:
            self._live.stop()

    def update(self, metrics: Mapping[str, Any]) -> None:
        """Show a trial's newest metrics."""
        if self._live is not None:
            self._live.update(self._table(metrics))
        elif time.monotonic() >= self._next_line or metrics.get("done"):
            self._next_line = time.monotonic() + SECONDS_PER_LINE
            line = f"{self._summary(metrics)}; " + "; ".join(self._policy(p, metrics) for p in self._policies)
            self._console.print(line, highlight=False, soft_wrap=True)

    def published(self, version: VersionRow) -> None:
        """Tell that a version is there."""
        parity = [policy.parity for policy in version.manifest.policies.values()]
        observations = sum(proof.observations for proof in parity)
        self._console.print(
            f"Published {version.ref} after {version.steps:,} steps: acts as trained on {observations:,} observations.",
            highlight=False,
            soft_wrap=True,
        )

    def _table(self, metrics: Mapping[str, Any]) -> Table:
        table = Table.grid(padding=(0, 2))
        table.add_row(_bar(self._fraction(metrics)), self._summary(metrics))
        for policy in self._policies:
            table.add_row("", self._policy(policy, metrics))
        return table

    def _summary(self, metrics: Mapping[str, Any]) -> str:
        fraction = self._fraction(metrics)
        left = metrics["seconds"] * (1 - fraction) / fraction if fraction else 0.0
        return (
            f"{fraction:4.0%}  {metrics['steps']:,} steps  {metrics['steps_per_second']:,.0f} steps/s  "
            f"{_clock(metrics['seconds'])} trained, {_clock(left)} to go"
        )

    def _policy(self, policy: str, metrics: Mapping[str, Any]) -> str:
        shown = (("return", "+.2f"), ("length", ".1f"), ("entropy", ".2f"))
        values = [f"{name} {metrics[key]:{form}}" for name, form in shown if (key := f"{policy}/{name}") in metrics]
        return f"{policy}: " + (", ".join(values) or "no episode is over yet")

    def _fraction(self, metrics: Mapping[str, Any]) -> float:
        """How much of the budget is spent: of steps or of time, whichever is further."""
        fraction = metrics["steps"] / self._settings.steps
        if self._settings.minutes is not None:
            fraction = max(fraction, metrics["seconds"] / (60 * self._settings.minutes))
        return min(fraction, 1.0)


def _bar(fraction: float, width: int = 30) -> Text:
    filled = round(fraction * width)
    return Text("━" * filled, style="green") + Text("━" * (width - filled), style="dim")


def _clock(seconds: float) -> str:
    return f"{int(seconds) // 60}:{int(seconds) % 60:02d}"
