from collections.abc import Iterator
from pathlib import Path

import pytest

from league.registry.registry import Registry
from league.settings import Storage
from tests.support.leagues.registries import interface
from tests.support.leagues.training_leagues import tictactoe


@pytest.fixture
def registry(tmp_path: Path) -> Iterator[Registry]:
    """A registry with the league, without versions."""
    opened = Registry.open(Storage.at(tmp_path / "home"))
    opened.leagues.register(tictactoe(), interface())
    yield opened
    opened.close()
