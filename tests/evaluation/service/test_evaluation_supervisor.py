"""Evaluation processes: the ledger keeps their games if they or their service die."""

import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path

import pytest
import ray

from evaluation.schedules.builders import round_robin
from evaluation.service import evaluation_supervisor
from evaluation.service.evaluation_supervisor import EvaluationSupervisor
from league.registry.registry import Registry
from league.registry.storage.rows import EvaluationRow
from league.results.ledger import Ledger
from league.settings import Storage
from league.subprocesses import Subprocess
from tests.support.databases import StorageAt, on_both_databases
from tests.support.leagues import tictactoe
from tests.support.processes import running_module
from tests.support.templates import copy_of
from tests.support.waiting import until

LONG = 20_000
"""A number of blocks that takes minutes."""


pytestmark = on_both_databases


def _with_two_versions(storage: Storage) -> Registry:
    registry = tictactoe.registry(storage.home, play={"opening_plies": 2, "num_envs": 2})
    for strength in ({}, {"wins": True}):
        tictactoe.publish(registry, tictactoe.graph(**strength))
    return registry


@pytest.fixture
def registry(tmp_path: Path, storage_at: StorageAt, monkeypatch: pytest.MonkeyPatch) -> Iterator[Registry]:
    opened = copy_of(_with_two_versions, storage_at(tmp_path / "home"))
    for name, value in opened.storage.environment.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(evaluation_supervisor, "POLL_INTERVAL", 0.02)
    yield opened
    opened.close()


@contextmanager
def running(registry: Registry, **options: object) -> Iterator[EvaluationSupervisor]:
    supervisor = EvaluationSupervisor(registry, **options)  # type: ignore[arg-type]
    supervisor.start()
    try:
        yield supervisor
    finally:
        supervisor.close()


def submit(registry: Registry, blocks: int) -> Callable[[], EvaluationRow]:
    """Submit an evaluation; returns a function that reads its row."""
    request = {"kind": "tournament", "schedule": "round_robin", "contestants": [], "blocks": blocks, "seed": 0}
    number = registry.evaluations.submit(tictactoe.LEAGUE, request, actor="test", max_active=8).id
    return lambda: registry.evaluations.get(tictactoe.LEAGUE, number)


def change_environment(registry: Registry, environment: str) -> None:
    """Give the league another environment with the same spaces."""
    config = tictactoe.config(environment={"entry_point": f"tests.support.environments.hanging:{environment}"})
    registry.leagues.register(config, registry.leagues.get(tictactoe.LEAGUE).interface)


def positions(registry: Registry, blocks: int) -> list[int]:
    row = registry.leagues.get(tictactoe.LEAGUE)
    schedule = round_robin(
        row.config, row.interface, ["tictactoe@1", "tictactoe@2", "script:random", "script:one_ply"], blocks
    )
    return sorted(Ledger(registry).positions(schedule.id))


@pytest.mark.slow
@pytest.mark.usefixtures("ray_session")
def test_workers_are_tasks_of_the_ray_cluster_that_the_process_joins(registry: Registry) -> None:
    evaluation = submit(registry, blocks=8)
    with running(registry, workers=2, address=ray.get_runtime_context().gcs_address):
        until(lambda: evaluation().ended_at is not None)
    row = evaluation()
    assert (row.state, row.error, row.workers) == ("done", None, 2)
    assert positions(registry, 8) == list(range(48))


def test_an_evaluation_that_does_not_stop_is_killed(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(evaluation_supervisor, "STOP_TIMEOUT", timedelta(seconds=0.1))
    change_environment(registry, "Hanging")
    evaluation = submit(registry, blocks=8)
    with running(registry) as supervisor:
        until(lambda: evaluation().progress is not None)
        (job,) = supervisor._jobs
        registry.evaluations.stop(tictactoe.LEAGUE, evaluation().id, actor="ada")
        until(lambda: evaluation().state == "stopped")
        assert not job.process.is_running


def test_an_exception_of_the_environment_is_reported(registry: Registry) -> None:
    change_environment(registry, "Raising")
    evaluation = submit(registry, blocks=8)
    with running(registry):
        until(lambda: evaluation().ended_at is not None)
    error = evaluation().error
    assert evaluation().state == "failed"
    assert error is not None
    assert "the board is gone" in error["message"]


SERVICE = """
import sys
from evaluation.service.evaluation_supervisor import EvaluationSupervisor
from league.registry.registry import Registry
EvaluationSupervisor(Registry.open()).start()
sys.stdin.read()
"""


@pytest.mark.slow
def test_an_evaluation_continues_after_its_service_was_killed(registry: Registry) -> None:
    evaluation = submit(registry, LONG)
    with subprocess.Popen(
        [sys.executable, "-c", SERVICE], cwd=Path(__file__).parents[3], stdin=subprocess.PIPE
    ) as service:
        until(lambda: evaluation().progress is not None)
        (process,) = running_module("evaluation.service.evaluation_job", service.pid)
        service.kill()
    until(lambda: evaluation().state == "queued" and not Path(f"/proc/{process}").exists())
    before = positions(registry, LONG)
    with running(registry):
        until(lambda: len(positions(registry, LONG)) > len(before))
        registry.evaluations.stop(tictactoe.LEAGUE, evaluation().id, actor="ada")
        until(lambda: evaluation().state == "stopped")
    after = positions(registry, LONG)
    assert after == list(range(len(after)))


def test_an_evaluation_whose_process_dies_repeatedly_fails(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(evaluation_supervisor, "Subprocess", lambda *_: Subprocess("no_such_module"))
    evaluation = submit(registry, blocks=8)
    with running(registry):
        until(lambda: evaluation().state == "failed")
    error = evaluation().error
    assert error is not None
    assert error["code"] == "worker_lost"
    assert registry.evaluations.claim("another", 1) is None
