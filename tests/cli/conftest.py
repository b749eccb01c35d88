from functools import partial
from pathlib import Path

import pytest

from league.registry.registry import Registry
from league.settings import Storage
from tests.support.command import League, in_process, in_subprocess
from tests.support.databases import StorageAt
from tests.support.leagues import tictactoe
from tests.support.templates import copy_of


@pytest.fixture
def home(tmp_path: Path) -> Path:
    return tmp_path / "home"


@pytest.fixture
def registry(home: Path, storage_at: StorageAt, monkeypatch: pytest.MonkeyPatch) -> Registry:
    """Three versions of tic-tac-toe: one that ignores threats, one that blocks, and one that wins and blocks."""
    registry = copy_of(_with_three_versions, storage_at(home))
    monkeypatch.setattr("evaluation.matches.leaderboard.MAX_UPSETS", 1)  # whose pictures take most of a nightly run
    monkeypatch.setenv("LEAGUE_DATABASE_URL", registry.storage.database_url)
    return registry


def _with_three_versions(storage: Storage) -> Registry:
    registry = tictactoe.registry(storage.home)
    for graph in (tictactoe.graph(), tictactoe.graph(blocks=True), tictactoe.graph(wins=True, blocks=True)):
        tictactoe.publish(registry, graph)
    return registry


@pytest.fixture
def league(home: Path) -> League:
    """The command in this process."""
    return partial(in_process, home)


@pytest.fixture
def league_process(home: Path) -> League:
    """The command in a subprocess, for commands that start Ray, and for exit codes and signals."""
    return partial(in_subprocess, home)
