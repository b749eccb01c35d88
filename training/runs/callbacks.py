"""Callbacks of the user's code, in the driver's process. docs/extending.md describes the interface for authors."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from inspect import isclass
from math import isfinite
from statistics import fmean
from typing import Any

from league.entry_points import import_entry_point
from league.errors import ConfigError, LeagueError, cause, no_exit
from league.interface import Interface
from league.registry.storage.rows import VersionRow
from training.sampling.play_metrics import PlayedEpisodes

CALLBACKS = "training.callbacks"
HOOKS = ("on_episode", "on_update", "on_version", "on_end")
OWN_METRICS = "callbacks/"
"""Prefix of the metrics that callbacks return."""


@dataclass(frozen=True, slots=True)
class FinishedEpisode:
    """A finished episode of training.

    length: environment steps. returns: agent → return, of the agents that the league's policies played.
    """

    length: int
    returns: dict[str, float]


def callback_class(entry_point: str) -> Callable[[], Any]:
    """Import a class of callbacks. Raises ConfigError if there is none, or it has none of the HOOKS."""
    imported = import_entry_point(CALLBACKS, entry_point)
    if not isclass(imported) or not any(callable(getattr(imported, hook, None)) for hook in HOOKS):
        raise ConfigError(
            f"{CALLBACKS}: {entry_point} is no class with a method {', '.join(HOOKS[:-1])} or {HOOKS[-1]}"
        )
    return imported


class Callbacks:
    """The instances of a run. The first exception ends training: its state is saved and published, and `end` raises.

    All methods except `add` are called by the driver's main thread.
    """

    def __init__(self, entry_points: Iterable[str], interface: Interface) -> None:
        """Raises ConfigError if an instance cannot be created."""
        self._instances: dict[str, Any] = {}
        for entry_point in entry_points:
            create = callback_class(entry_point)
            try:
                with no_exit:
                    self._instances[entry_point] = create()
            except Exception as error:
                raise ConfigError(f"{CALLBACKS}: {entry_point} cannot be created{cause(error)}") from error
        self._agents = tuple(interface.agents)
        self._versions: deque[VersionRow] = deque()
        self.error: LeagueError | None = None
        """The fault of a callback, after which none is called."""
        self.request_stop: Callable[[], None] = lambda: None
        """Called at the first fault."""

    def add(self, version: VersionRow) -> None:
        """Pass on a published version, from any thread, with the next report."""
        self._versions.append(version)

    def report(self, episodes: Iterable[PlayedEpisodes], updates: Sequence[Mapping[str, float]]) -> dict[str, float]:
        """Call the hooks for what has happened since the last report; return their metrics, prefixed.

        Those of episodes are means, and those of updates the last values.
        """
        metrics: dict[str, float] = {}
        if not self._instances:
            return metrics
        of_episodes: dict[str, list[float]] = {}
        for episode in self._episodes(episodes):
            for name, value in self._call("on_episode", episode).items():
                of_episodes.setdefault(name, []).append(value)
        metrics |= {name: fmean(values) for name, values in of_episodes.items()}
        for update in updates:
            metrics |= self._call("on_update", dict(update))
        self._pass_versions()
        return {f"{OWN_METRICS}{name}": value for name, value in metrics.items()}

    def end(self, versions: Sequence[VersionRow]) -> None:
        """Call the hooks of the end. Raises the fault of a callback, if there was one."""
        self._pass_versions()
        self._call("on_end", list(versions))
        if self.error is not None:
            raise self.error

    def _pass_versions(self) -> None:
        while self._versions:
            self._call("on_version", self._versions.popleft())

    def _episodes(self, parts: Iterable[PlayedEpisodes]) -> Iterator[FinishedEpisode]:
        for part in parts:
            for length, steps, returns in zip(part.lengths, part.steps, part.returns, strict=True):
                agents = zip(self._agents, steps, returns, strict=True)
                yield FinishedEpisode(int(length), {agent: float(total) for agent, count, total in agents if count})

    def _call(self, hook: str, argument: Any) -> dict[str, float]:
        """Call a hook of all instances that have it, unless one has failed; return their metrics."""
        metrics: dict[str, float] = {}
        for name, instance in self._instances.items():
            method = getattr(instance, hook, None)
            if method is None or self.error is not None:
                continue
            try:
                with no_exit:
                    metrics |= _metrics(method(argument))
            except Exception as error:
                self.error = LeagueError(
                    f"{CALLBACKS}: {name}.{hook} raises{cause(error)}; training ended, and its state is published:"
                    " correct the callback, then continue with --resume"
                )
                self.request_stop()
        return metrics


def _metrics(result: Any) -> dict[str, float]:
    """Return the metrics that a hook has returned, None for none. Raises TypeError."""
    if result is None:
        return {}
    if isinstance(result, Mapping):
        metrics = {name: float(value) for name, value in result.items()}
        if all(isinstance(name, str) and name for name in metrics):
            return {name: value for name, value in metrics.items() if isfinite(value)}
    raise TypeError(f"it returned {str(result)[:80]!r}, expected None or a dictionary from names to numbers")
