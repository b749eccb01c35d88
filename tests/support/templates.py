"""Homes that many tests need: built once per process, then copied."""

import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

from league.registry.registry import Registry
from league.settings import Storage
from tests.support.databases import copy_rows


def copy_of(build: Callable[[Storage], Registry], storage: Storage) -> Registry:
    """The registry that `build` creates in an empty home, copied to `storage`, an empty home with any database."""
    template = Storage.at(_build_once(build))
    if storage.database_url == Storage.at(storage.home).database_url:
        shutil.copytree(template.home, storage.home, dirs_exist_ok=True)
        return Registry.open(storage)
    shutil.copytree(template.home, storage.home, dirs_exist_ok=True, ignore=shutil.ignore_patterns("league.db*"))
    copied, source = Registry.open(storage), Registry.open(template)
    copy_rows(source, copied)
    source.close()
    return copied


@contextmanager
def copied(home: Path, to: Path) -> Iterator[Registry]:
    """A copy of a home, which a test may change."""
    registry = Registry.open(Storage.at(Path(shutil.copytree(home, to))))
    yield registry
    registry.close()


@cache
def _build_once(build: Callable[[Storage], Registry]) -> Path:
    directory = tempfile.TemporaryDirectory(prefix="league-template-")
    _kept.append(directory)
    home = Path(directory.name)
    build(Storage.at(home)).close()
    return home


_kept: list["tempfile.TemporaryDirectory[str]"] = []
"""Removed when the process exits."""
