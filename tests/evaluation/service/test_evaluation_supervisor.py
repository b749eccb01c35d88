"""Evaluation processes: where their matches are played, and that the ledger keeps them if they or their service die."""

import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
import ray

from evaluation.schedules.builders import round_robin
from evaluation.service import evaluation_job, evaluation_supervisor
from evaluation.service.evaluation_supervisor import EvaluationJobOptions, EvaluationSupervisor
from league.errors import InvalidInput
from league.registry.registry import Registry
from league.registry.storage.rows import EvaluationRow
from league.results import ledger
from league.results.ledger import Ledger
from league.settings import Storage
from league.subprocesses import Subprocess
from tests.support.databases import StorageAt, on_both_databases
from tests.support.leagues import tictactoe
from tests.support.leagues.judged_league import reconfigure
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


def submit(registry: Registry, blocks: int, contestants: Sequence[str] = ()) -> Callable[[], EvaluationRow]:
    """Submit an evaluation; returns a function that reads its row."""
    request = {
        "kind": "tournament",
        "schedule": "round_robin",
        "contestants": list(contestants),
        "blocks": blocks,
        "seed": 0,
    }
    number = registry.evaluations.submit(tictactoe.LEAGUE, request, actor="test", max_active=8).id
    return lambda: registry.evaluations.get(tictactoe.LEAGUE, number)


def change_environment(registry: Registry, environment: str) -> None:
    """Give the league another environment with the same spaces."""
    entry_point = f"tests.support.environments.hanging:{environment}"
    reconfigure(registry, tictactoe.config(environment={"entry_point": entry_point}))


def positions(registry: Registry, blocks: int) -> list[int]:
    row, refs = (
        registry.leagues.get(tictactoe.LEAGUE),
        ["tictactoe@1", "tictactoe@2", "script:random", "script:one_ply"],
    )
    return sorted(Ledger(registry).positions(round_robin(row.config, row.interface, refs, blocks).id))


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
    assert (evaluation().state, "the board is gone" in evaluation().error["message"]) == ("failed", True)


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
    command = [sys.executable, "-c", SERVICE]
    with subprocess.Popen(command, cwd=Path(__file__).parents[3], stdin=subprocess.PIPE) as service:
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
    assert evaluation().error["code"] == "worker_lost"
    assert registry.evaluations.claim("another", 1) is None


def run(registry: Registry, workers: int) -> None:
    """Claim the evaluation that waits, and run it in this process."""
    number = registry.evaluations.claim("runner", workers).id
    evaluation_job.run_evaluation(EvaluationJobOptions(number, tictactoe.LEAGUE, "runner", workers, None), registry)


def test_one_worker_is_the_process_and_several_are_tasks(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    tasks: list[int] = []

    def evaluate(*_: Any, workers: int, **__: Any) -> None:
        tasks.append(workers)
        raise InvalidInput("no match is played")

    monkeypatch.setattr(evaluation_job, "evaluate", evaluate)
    for workers in (1, 2, 3):
        evaluation = submit(registry, blocks=1)
        run(registry, workers)
        assert evaluation().state == "failed"
    assert tasks == [0, 2, 3]


def test_an_evaluation_without_space_for_its_games_fails(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ledger, "MOST_BYTES", 2000)
    evaluation = submit(registry, blocks=1000, contestants=("script:random", "script:one_ply"))
    run(registry, 1)
    assert (evaluation().state, evaluation().error["code"]) == ("failed", "out_of_space")
