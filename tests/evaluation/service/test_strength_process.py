"""The process that measures strength: responses, errors, and a process that has died."""

import os
import signal
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest

from evaluation.matches.worker import MatchWorker
from evaluation.service.strength_process import StrengthProcess
from evaluation.service.strength_worker import measured
from league.errors import LeagueError, UnknownVersion, WorkerLost
from league.registry.registry import Registry
from league.registry.storage.rows import VersionRow
from tests.support.leagues import tictactoe


@pytest.fixture
def registry(tmp_path: Path) -> Iterator[Registry]:
    opened = tictactoe.registry(tmp_path / "home", play={"opening_plies": 2, "num_envs": 2})
    yield opened
    opened.close()


@pytest.fixture
def version(registry: Registry) -> VersionRow:
    return tictactoe.publish(registry, tictactoe.graph(wins=True))


def process_id(measure: StrengthProcess) -> int:
    pid = measure._process.pid
    assert pid is not None
    return pid


def test_a_process_plays_reports_errors_and_is_replaced(registry: Registry, version: VersionRow) -> None:
    with closing(StrengthProcess(registry.storage)) as measure:
        (row,) = measure(version, 4)
        assert (row.version, row.opponent, row.games) == (1, "script:random", 4)
        first = process_id(measure)
        assert os.getpriority(os.PRIO_PROCESS, first) == 19
        with pytest.raises(UnknownVersion, match="tictactoe has no version 9"):
            measure(replace(version, number=9), 4)
        os.kill(first, signal.SIGKILL)
        with pytest.raises(WorkerLost, match="died"):
            measure(version, 4)
        assert measure(version, 4)[0].score == row.score
    with pytest.raises(WorkerLost, match="ended"):
        measure(version, 4)


def test_an_exception_of_a_policy_is_a_response(registry: Registry, version: VersionRow) -> None:
    class Broken(MatchWorker):
        def contestant(self, ref: str) -> dict:
            raise RuntimeError("no such layer")

    worker = Broken(registry.leagues.get(tictactoe.LEAGUE).config, registry)
    with pytest.raises(LeagueError, match=r"^RuntimeError: no such layer$"):
        measured(registry, worker, {"version": version.number, "games": 4})
