"""Algorithms of a league that run in this process."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from league.config.league import LeagueConfig
from league.environments.building import interface
from league.settings import Storage
from training.runs.trial import build_algorithm


@contextmanager
def running(league: LeagueConfig, checkpoint: Path | None = None, storage: Storage | None = None) -> Iterator[Any]:
    """Yields an algorithm at its first step, or with the state of a checkpoint; it is stopped at the end."""
    algorithm = build_algorithm(league, interface(league), checkpoint, storage=storage)
    try:
        if checkpoint is None:
            algorithm.reset_episodes(0)
        yield algorithm
    finally:
        algorithm.stop()
