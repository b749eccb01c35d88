"""The processes that play evaluations: what they play is the ledger's, whatever becomes of them and of their studio."""

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path

import pytest
import ray

from evaluation import runners
from evaluation.runners import Runners
from evaluation.schedule import round_robin
from league.registry.registry import Registry
from league.registry.rows import EvaluationRow
from league.results.ledger import Ledger
from tests.evaluation import examples
from tests.evaluation.waiting import until

LONG = 20_000
"""Blocks that take minutes."""


@pytest.fixture
def registry(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Registry]:
    opened = examples.registry(tmp_path / "home", play={"opening_plies": 2, "copies": 2})
    for strength in ({}, {"wins": True}):
        examples.publish(opened, examples.graph(**strength))
    for name, value in (
        ("LEAGUE_HOME", opened.storage.home),
        ("LEAGUE_DATABASE_URL", opened.storage.database_url),
        ("LEAGUE_ARTIFACTS", opened.storage.artifacts),
    ):
        monkeypatch.setenv(name, str(value))
    yield opened
    opened.close()


@contextmanager
def at_work(registry: Registry, **options: object) -> Iterator[Runners]:
    working = Runners(registry, **options)  # type: ignore[arg-type]
    working.start()
    try:
        yield working
    finally:
        working.close()


def ask(registry: Registry, blocks: int) -> Callable[[], EvaluationRow]:
    """How an evaluation is, that was asked for."""
    asked = {"kind": "tournament", "schedule": "round_robin", "contestants": [], "blocks": blocks, "seed": 0}
    number = registry.ask_evaluation(examples.LEAGUE, asked, actor="test", most=8).id
    return lambda: registry.evaluation(examples.LEAGUE, number)


def plays(registry: Registry, environment: str) -> None:
    """Give the league another environment, with the same spaces."""
    config = examples.config(environment={"entry_point": f"tests.evaluation.hanging:{environment}"})
    registry.register(config, registry.league(examples.LEAGUE).interface)


def positions(registry: Registry, blocks: int) -> list[int]:
    row = registry.league(examples.LEAGUE)
    schedule = round_robin(
        row.config, row.interface, ["tictactoe@1", "tictactoe@2", "script:random", "script:one_ply"], blocks
    )
    return sorted(Ledger(registry).positions(schedule.id))


@pytest.mark.usefixtures("ray_session")
def test_several_workers_are_tasks_of_the_ray_that_the_process_joins(registry: Registry) -> None:
    evaluation = ask(registry, blocks=8)
    with at_work(registry, workers=2, address=ray.get_runtime_context().gcs_address):
        until(lambda: evaluation().ended_at is not None)
    row = evaluation()
    assert (row.state, row.error, row.workers) == ("done", None, 2)
    assert positions(registry, 8) == list(range(48))


def test_one_that_does_not_stop_is_killed(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runners, "GRACE", timedelta(seconds=0.5))
    plays(registry, "Hanging")
    evaluation = ask(registry, blocks=8)
    with at_work(registry):
        until(lambda: evaluation().progress is not None)
        (process,) = jobs_below(os.getpid())
        registry.stop_evaluation(examples.LEAGUE, evaluation().id, actor="ada")
        until(lambda: evaluation().state == "stopped")
        assert process not in jobs_below(os.getpid())


def test_what_an_environment_raises_is_told(registry: Registry) -> None:
    plays(registry, "Raising")
    evaluation = ask(registry, blocks=8)
    with at_work(registry):
        until(lambda: evaluation().ended_at is not None)
    error = evaluation().error
    assert evaluation().state == "failed"
    assert error is not None
    assert "the board is gone" in error["message"]


STUDIO = """
import sys
from evaluation.runners import Runners
from league.registry.registry import Registry
Runners(Registry.open()).start()
sys.stdin.read()
"""


def test_what_a_studio_that_was_killed_leaves_goes_on_with_the_next(registry: Registry) -> None:
    evaluation = ask(registry, LONG)
    with subprocess.Popen(
        [sys.executable, "-c", STUDIO], cwd=Path(__file__).parents[2], stdin=subprocess.PIPE
    ) as studio:
        until(lambda: evaluation().progress is not None)
        (process,) = jobs_below(studio.pid)
        studio.kill()
    until(lambda: evaluation().state == "queued" and not Path(f"/proc/{process}").exists())
    before = positions(registry, LONG)
    with at_work(registry):
        until(lambda: len(positions(registry, LONG)) > len(before))
        registry.stop_evaluation(examples.LEAGUE, evaluation().id, actor="ada")
        until(lambda: evaluation().state == "stopped")
    after = positions(registry, LONG)
    assert after == list(range(len(after)))


def test_a_process_that_dies_at_once_again_and_again_is_given_up(
    registry: Registry, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "executable", "/bin/false")
    monkeypatch.setattr(runners, "LOOK", 0.01)
    evaluation = ask(registry, blocks=8)
    with at_work(registry):
        until(lambda: evaluation().state == "failed")
    error = evaluation().error
    assert error is not None
    assert error["code"] == "worker_lost"
    assert registry.claim_evaluation("another", 1) is None


def jobs_below(parent: int) -> list[int]:
    """The ids of a process's runners."""
    children = Path(f"/proc/{parent}/task").glob("*/children")
    found = [int(child) for path in children for child in path.read_text().split()]
    return [child for child in found if b"evaluation.job" in Path(f"/proc/{child}/cmdline").read_bytes()]
