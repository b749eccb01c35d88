"""Homes that many tests need: built once per process, then copied."""

import shutil
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path

from league.registry.registry import Registry
from league.settings import Storage


def copy_of(build: Callable[[Storage], Registry], storage: Storage) -> Registry:
    """The registry that `build` creates in an empty home, copied to `storage`, an empty home with SQLite."""
    shutil.copytree(_build_once(build), storage.home, dirs_exist_ok=True)
    return Registry.open(storage)


@cache
def _build_once(build: Callable[[Storage], Registry]) -> Path:
    directory = tempfile.TemporaryDirectory(prefix="league-template-")
    _kept.append(directory)
    home = Path(directory.name)
    build(Storage.at(home)).close()
    return home


_kept: list["tempfile.TemporaryDirectory[str]"] = []
"""Removed when the process exits."""
