"""Snapshots follow each change; they are computed by one process at a time, which ends with its service."""

import asyncio
import logging
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from evaluation.matches.tournament import evaluate
from evaluation.service import deployment, snapshot_refresher
from evaluation.service.deployment import EvaluationService
from evaluation.service.snapshot_refresher import SnapshotRefresher
from league.environments.building import interface
from league.registry.registry import Registry
from league.registry.snapshots import SnapshotRepository
from league.subprocesses import RequestProcess
from tests.support.leagues import tictactoe
from tests.support.leagues.tictactoe import LEAGUE
from tests.support.processes import running_module
from tests.support.waiting import until


@pytest.fixture
def registry(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Registry]:
    opened = tictactoe.registry(tmp_path / "home")
    for name, value in opened.storage.environment.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(snapshot_refresher, "POLL_INTERVAL", 0.05)
    monkeypatch.setattr(snapshot_refresher, "IDLE_FACTOR", 0)
    yield opened
    opened.close()


@contextmanager
def running(registry: Registry) -> Iterator[SnapshotRefresher]:
    refresher = SnapshotRefresher(registry)
    refresher.start()
    try:
        yield refresher
    finally:
        refresher.close()


def another_league(registry: Registry, name: str) -> None:
    config = tictactoe.config(league=name)
    registry.leagues.register(config, interface(config))


def play(registry: Registry, seed: int) -> int:
    """Play two blocks; returns the number of games."""
    return evaluate(LEAGUE, ["script:random", "script:first"], registry=registry, blocks=2, seed=seed).games


def errors(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records if record.module == "snapshot_refresher"]


def games(registry: Registry) -> int:
    row = registry.snapshots.get(LEAGUE, "summary")
    return row.document["games"] if row else 0


def test_snapshots_follow_the_ledger(registry: Registry, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.ERROR), running(registry) as refresher:
        until(lambda: registry.snapshots.get(LEAGUE, "summary") is not None)
        first = play(registry, seed=1)
        until(lambda: games(registry) == first)
        second = play(registry, seed=2)
        until(lambda: games(registry) == first + second)
        assert refresher.is_alive()
    assert not refresher.is_alive()
    assert errors(caplog) == [], "processes exit with status 0"


@pytest.mark.slow
def test_two_refreshers_do_not_conflict(registry: Registry) -> None:
    another_league(registry, "chess")
    with running(registry), running(registry):
        played = play(registry, seed=1)
        until(lambda: registry.snapshots.stale() == [])
    assert games(registry) == played


def test_a_league_whose_process_fails_is_delayed_and_the_others_are_refreshed(
    registry: Registry, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    another_league(registry, "chess")
    process = RequestProcess("no_such_module", work="computes nothing")
    monkeypatch.setattr(snapshot_refresher, "RequestProcess", lambda *_, **__: process)
    checks = []
    stale = registry.snapshots.stale
    monkeypatch.setattr(registry.snapshots, "stale", lambda: checks.append(1) or stale())
    with caplog.at_level(logging.ERROR), running(registry):
        until(lambda: len(checks) > 6)
    failed = sorted(message.partition(" failed")[0] for message in errors(caplog))
    assert failed == [f"computing the snapshots of league {name}" for name in ("chess", LEAGUE)]


def test_refreshing_resumes_when_the_database_is_back(registry: Registry, caplog: pytest.LogCaptureFixture) -> None:
    database = registry.storage.home / "league.db"
    with caplog.at_level(logging.ERROR), running(registry):
        until(lambda: registry.snapshots.stale() == [])
        moved = database.rename(database.with_name("away.db"))
        until(lambda: "snapshots cannot be refreshed" in caplog.text)
        moved.rename(database)
        played = play(registry, seed=1)
        until(lambda: games(registry) == played)


@pytest.mark.usefixtures("ray_session")
@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_service_works_until_snapshots_are_current(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(deployment, "POLL", 0.05)
    service = EvaluationService(workers=1, at_once=1)
    play(registry, seed=1)
    asyncio.run(service.work())
    assert registry.snapshots.stale() == []
    service.check_health()

    def raise_error(_: SnapshotRepository) -> list[str]:
        raise ZeroDivisionError

    monkeypatch.setattr(SnapshotRepository, "stale", raise_error)
    until(lambda: is_unhealthy(service))


def is_unhealthy(service: EvaluationService) -> bool:
    try:
        service.check_health()
    except RuntimeError:
        return True
    return False


SERVICE = """
import sys
from evaluation.service import snapshot_refresher
from league.registry.registry import Registry
snapshot_refresher.POLL_INTERVAL, snapshot_refresher.IDLE_FACTOR = 0.1, 0
snapshot_refresher.SnapshotRefresher(Registry.open()).start()
sys.stdin.read()
"""


@pytest.mark.slow
def test_a_process_ends_with_its_service_and_the_next_one_starts_over(registry: Registry) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", SERVICE], cwd=Path(__file__).parents[3], stdin=subprocess.PIPE
    ) as service:
        until(lambda: len(running_module("evaluation.service.snapshots", service.pid)) == 1)
        (process,) = running_module("evaluation.service.snapshots", service.pid)
        service.kill()
    until(lambda: not Path(f"/proc/{process}").exists())
    with running(registry):
        until(lambda: registry.snapshots.stale() == [])
