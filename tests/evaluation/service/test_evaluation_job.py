"""Evaluation jobs: where the matches of an evaluation are played."""

from pathlib import Path
from typing import Any

import pytest

from evaluation.service import evaluation_job
from evaluation.service.evaluation_supervisor import EvaluationJobOptions
from league.errors import InvalidInput
from league.results import ledger
from tests.support.leagues import tictactoe


@pytest.mark.parametrize(("workers", "tasks"), [(1, 0), (2, 2), (3, 3)])
def test_one_worker_is_the_process_itself_and_several_are_ray_tasks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, workers: int, tasks: int
) -> None:
    given: list[int] = []

    def evaluate(*_: Any, workers: int, **__: Any) -> None:
        given.append(workers)
        raise InvalidInput("no match is played")

    monkeypatch.setattr(evaluation_job, "evaluate", evaluate)
    registry = tictactoe.registry(tmp_path / "home")
    request = {"kind": "tournament", "schedule": "round_robin", "contestants": [], "blocks": 1, "seed": 0}
    registry.evaluations.submit(tictactoe.LEAGUE, request, actor="test", max_active=1)
    claimed = registry.evaluations.claim("runner", workers)
    assert claimed is not None
    evaluation_job.run_evaluation(EvaluationJobOptions(claimed.id, tictactoe.LEAGUE, "runner", workers, None), registry)
    assert given == [tasks]
    assert registry.evaluations.get(tictactoe.LEAGUE, claimed.id).state == "failed"
    registry.close()


def test_an_evaluation_without_space_for_its_games_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ledger, "MOST_BYTES", 2000)
    registry = tictactoe.registry(tmp_path / "home")
    scripts = ["script:random", "script:one_ply"]
    request = {"kind": "tournament", "schedule": "round_robin", "contestants": scripts, "blocks": 1000, "seed": 0}
    registry.evaluations.submit(tictactoe.LEAGUE, request, actor="test", max_active=1)
    claimed = registry.evaluations.claim("runner", 1)
    assert claimed is not None
    evaluation_job.run_evaluation(EvaluationJobOptions(claimed.id, tictactoe.LEAGUE, "runner", 1, None), registry)
    ended = registry.evaluations.get(tictactoe.LEAGUE, claimed.id)
    assert ended.error is not None
    assert (ended.state, ended.error["code"]) == ("failed", "out_of_space")
    registry.close()
