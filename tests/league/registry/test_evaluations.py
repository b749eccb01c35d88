"""Evaluations in the registry: each is claimed by one runner, continues if that runner dies, and ends once."""

from concurrent.futures import ThreadPoolExecutor

import pytest

from league.errors import TooManyEvaluations, UnknownEvaluation
from league.registry.evaluations import MAX_ATTEMPTS
from league.registry.registry import Registry
from league.registry.snapshots import SUMMARY
from league.registry.storage.rows import EvaluationRow
from tests.support.databases import on_both_databases
from tests.support.leagues.registries import LEAGUE, expire_heartbeats

REQUEST = {"kind": "tournament", "blocks": 4}


def submit(registry: Registry, max_active: int = 8) -> EvaluationRow:
    return registry.evaluations.submit(LEAGUE, REQUEST, actor="bot", reason="test", max_active=max_active)


def test_an_evaluation_is_submitted_claimed_and_completed(registry: Registry) -> None:
    submitted = submit(registry)
    assert (submitted.state, submitted.request, submitted.actor, submitted.started_at) == (
        "queued",
        REQUEST,
        "bot",
        None,
    )
    claimed = registry.evaluations.claim("a", workers=2)
    assert claimed is not None
    assert (claimed.id, claimed.state, claimed.runner, claimed.workers) == (submitted.id, "running", "a", 2)
    assert registry.evaluations.claim("b", workers=2) is None
    assert registry.evaluations.counts() == {LEAGUE: {"running": 1}}
    with pytest.raises(UnknownEvaluation, match="has no evaluation 7"):
        registry.evaluations.get(LEAGUE, 7)
    progress = {"what": "3 contestants", "played": 1, "of": 12}
    assert registry.evaluations.heartbeat(submitted.id, "a", progress).progress == progress
    registry.evaluations.finish(submitted.id, "a", "done", result={"games": 24})
    ended = registry.evaluations.get(LEAGUE, submitted.id)
    assert (ended.state, ended.result, ended.progress, ended.error) == ("done", {"games": 24}, progress, None)
    assert submitted.created_at <= claimed.started_at <= ended.ended_at  # type: ignore[operator]
    assert registry.evaluations.counts() == {}


def test_the_service_is_needed_while_snapshots_are_outdated_or_evaluations_are_active(registry: Registry) -> None:
    assert registry.needs_evaluation_service()
    registry.snapshots.put(LEAGUE, {SUMMARY: {}}, registry.snapshots.current_marks()[LEAGUE])
    assert not registry.needs_evaluation_service()
    submitted = submit(registry)
    assert registry.needs_evaluation_service()
    registry.evaluations.claim("a", workers=1)
    assert registry.needs_evaluation_service()
    registry.evaluations.finish(submitted.id, "a", "done", result={})
    assert not registry.needs_evaluation_service()


@on_both_databases
def test_the_oldest_is_claimed_first_and_by_one_runner(registry: Registry) -> None:
    numbers = [submit(registry).id for _ in range(3)]
    with ThreadPoolExecutor(6) as pool:
        claimed = list(pool.map(lambda name: registry.evaluations.claim(str(name), 1), range(6)))
    assert sorted(row.id for row in claimed if row is not None) == numbers


def test_an_evaluation_of_a_silent_runner_moves_to_another(registry: Registry) -> None:
    number = submit(registry).id
    registry.evaluations.claim("a", 1)
    expire_heartbeats(registry, EvaluationRow)
    reclaimed = registry.evaluations.claim("b", 1)
    assert reclaimed is not None
    assert (reclaimed.id, reclaimed.runner) == (number, "b")
    assert registry.evaluations.heartbeat(number, "a", {"played": 9}).runner == "b"
    registry.evaluations.finish(number, "a", "failed", error={"code": "x", "message": "y"})
    registry.evaluations.release(number, "a")
    row = registry.evaluations.get(LEAGUE, number)
    assert (row.state, row.runner, row.progress) == ("running", "b", None)


def test_repeated_crashes_without_progress_fail_an_evaluation(registry: Registry) -> None:
    number = submit(registry).id
    for attempt in range(MAX_ATTEMPTS):
        assert registry.evaluations.claim(f"a{attempt}", 1) is not None
        registry.evaluations.heartbeat(number, f"a{attempt}", {"played": 1})
        expire_heartbeats(registry, EvaluationRow)
    assert registry.evaluations.claim("last", 1) is not None, "the first attempt made progress"
    registry.evaluations.release(number, "last")
    row = registry.evaluations.get(LEAGUE, number)
    assert (row.state, row.error and row.error["code"]) == ("failed", "worker_lost")


def test_a_stopped_evaluation_is_not_restarted(registry: Registry) -> None:
    running, queued = submit(registry).id, submit(registry).id
    registry.evaluations.claim("a", 1)
    stopped = registry.evaluations.stop(LEAGUE, queued, actor="ada")
    assert (stopped.state, stopped.stopped_by) == ("stopped", "ada")
    registry.evaluations.release(running, "a")
    assert registry.evaluations.get(LEAGUE, running).state == "queued", "its runner is gone"
    registry.evaluations.claim("a", 1)
    requested = registry.evaluations.stop(LEAGUE, running, actor="ada")
    assert (requested.state, requested.stopped_by) == ("running", "ada")
    assert registry.evaluations.stop(LEAGUE, running, actor="bob") == requested, "a second stop has no effect"
    assert registry.evaluations.heartbeat(running, "a").stop_at is not None
    expire_heartbeats(registry, EvaluationRow)
    assert registry.evaluations.claim("b", 1) is None
    assert registry.evaluations.get(LEAGUE, running).state == "stopped"


def test_evaluations_are_limited_and_listed_newest_first(registry: Registry) -> None:
    numbers = [submit(registry).id for _ in range(5)]
    with pytest.raises(TooManyEvaluations, match="5 evaluations are queued or running"):
        submit(registry, max_active=5)
    assert [row.id for row in registry.evaluations.newest(LEAGUE, limit=2)] == numbers[:2:-1]
    assert [row.id for row in registry.evaluations.newest(LEAGUE, before=numbers[2], limit=5)] == numbers[1::-1]
