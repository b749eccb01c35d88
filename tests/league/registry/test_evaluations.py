"""Evaluations in the registry: each is claimed by one, goes on when its runner dies, and ends once."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import UTC, datetime, timedelta

import pytest
from sqlalchemy import update

from league.errors import KeyReused, TooManyEvaluations, UnknownEvaluation, UnknownLeague
from league.registry.evaluations import ATTEMPTS, SILENT
from league.registry.idempotency import Call
from league.registry.registry import Registry
from league.registry.rows import EvaluationRow
from league.registry.tables import Evaluation
from tests.league.registry.examples import LEAGUE

ASKED = {"kind": "tournament", "blocks": 4}


def ask(registry: Registry, most: int = 8) -> EvaluationRow:
    return registry.ask_evaluation(LEAGUE, ASKED, actor="bot", reason="test", most=most)


def falls_silent(registry: Registry) -> None:
    """Whoever runs something has said nothing for long."""
    with registry.database.write() as session:
        session.execute(update(Evaluation).values(heartbeat_at=datetime.now(UTC) - SILENT - timedelta(seconds=1)))


def test_one_is_asked_for_played_and_done(registry: Registry) -> None:
    asked = ask(registry)
    assert (asked.state, asked.asked, asked.actor, asked.started_at) == ("queued", ASKED, "bot", None)
    claimed = registry.claim_evaluation("a", workers=2)
    assert claimed is not None
    assert (claimed.id, claimed.state, claimed.runner, claimed.workers) == (asked.id, "running", "a", 2)
    assert registry.claim_evaluation("b", workers=2) is None
    assert registry.evaluation_counts() == {LEAGUE: {"running": 1}}
    progress = {"what": "3 contestants", "played": 1, "of": 12}
    assert registry.beat_evaluation(asked.id, "a", progress).progress == progress
    registry.finish_evaluation(asked.id, "a", "done", result={"games": 24})
    ended = registry.evaluation(LEAGUE, asked.id)
    assert (ended.state, ended.result, ended.progress, ended.error) == ("done", {"games": 24}, progress, None)
    assert asked.created_at <= claimed.started_at <= ended.ended_at  # type: ignore[operator]
    assert registry.evaluation_counts() == {}


def test_the_oldest_comes_first_and_of_many_runners_one_gets_it(registry: Registry) -> None:
    numbers = [ask(registry).id for _ in range(3)]
    with ThreadPoolExecutor(6) as pool:
        claimed = list(pool.map(lambda name: registry.claim_evaluation(str(name), 1), range(6)))
    assert sorted(each.id for each in claimed if each is not None) == numbers


def test_what_a_silent_runner_had_goes_to_another_and_the_first_is_heard_no_more(registry: Registry) -> None:
    number = ask(registry).id
    registry.claim_evaluation("a", 1)
    falls_silent(registry)
    again = registry.claim_evaluation("b", 1)
    assert again is not None
    assert (again.id, again.runner) == (number, "b")
    assert registry.beat_evaluation(number, "a", {"played": 9}).runner == "b"
    registry.finish_evaluation(number, "a", "failed", error={"code": "x", "message": "y"})
    registry.release_evaluation(number, "a")
    row = registry.evaluation(LEAGUE, number)
    assert (row.state, row.runner, row.progress) == ("running", "b", None)


def test_what_is_released_waits_again(registry: Registry) -> None:
    number = ask(registry).id
    registry.claim_evaluation("a", 1)
    registry.release_evaluation(number, "a")
    assert registry.evaluation(LEAGUE, number).state == "queued"
    assert registry.claim_evaluation("b", 1) is not None


def test_one_that_kills_its_runners_is_given_up_unless_it_gets_on(registry: Registry) -> None:
    number = ask(registry).id
    for attempt in range(ATTEMPTS):
        assert registry.claim_evaluation(f"a{attempt}", 1) is not None
        if attempt == 0:
            registry.beat_evaluation(number, "a0", {"played": 1})
        else:
            registry.beat_evaluation(number, f"a{attempt}", {"played": 1})
        falls_silent(registry)
    assert registry.claim_evaluation("last", 1) is not None, "the first one got on"
    registry.release_evaluation(number, "last")
    row = registry.evaluation(LEAGUE, number)
    assert (row.state, row.error and row.error["code"]) == ("failed", "worker_lost")


def test_what_waits_is_stopped_at_once_and_what_runs_is_asked_to(registry: Registry) -> None:
    running, waiting = ask(registry).id, ask(registry).id
    registry.claim_evaluation("a", 1)
    stopped = registry.stop_evaluation(LEAGUE, waiting, actor="ada")
    assert (stopped.state, stopped.stopped_by) == ("stopped", "ada")
    asked = registry.stop_evaluation(LEAGUE, running, actor="ada")
    assert (asked.state, asked.stopped_by) == ("running", "ada")
    assert registry.stop_evaluation(LEAGUE, running, actor="bob") == asked, "twice is once"
    assert registry.beat_evaluation(running, "a").stop_at is not None
    registry.release_evaluation(running, "a")
    assert registry.evaluation(LEAGUE, running).state == "stopped"
    assert registry.stop_evaluation(LEAGUE, waiting, actor="bob") == stopped


def test_what_was_to_stop_is_not_begun_again(registry: Registry) -> None:
    number = ask(registry).id
    registry.claim_evaluation("a", 1)
    registry.stop_evaluation(LEAGUE, number, actor="ada")
    falls_silent(registry)
    assert registry.claim_evaluation("b", 1) is None
    assert registry.evaluation(LEAGUE, number).state == "stopped"


def test_there_is_a_bound(registry: Registry) -> None:
    first = ask(registry, most=2)
    registry.claim_evaluation("a", 1)
    ask(registry, most=2)
    with pytest.raises(TooManyEvaluations, match="2 evaluations are queued or running"):
        ask(registry, most=2)
    registry.finish_evaluation(first.id, "a", "done", result={})
    assert ask(registry, most=2).state == "queued"


def test_they_are_listed_newest_first(registry: Registry) -> None:
    numbers = [ask(registry).id for _ in range(5)]
    assert [row.id for row in registry.evaluations(LEAGUE)] == numbers[::-1]
    assert [row.id for row in registry.evaluations(LEAGUE, limit=2)] == numbers[:2:-1]
    assert [row.id for row in registry.evaluations(LEAGUE, before=numbers[2], limit=5)] == numbers[1::-1]


def test_what_is_not_there_is_named(registry: Registry) -> None:
    with pytest.raises(UnknownLeague, match="chess"):
        registry.ask_evaluation("chess", ASKED, actor="bot", most=8)
    with pytest.raises(UnknownEvaluation, match="has no evaluation 7"):
        registry.evaluation(LEAGUE, 7)
    with pytest.raises(UnknownLeague):
        registry.evaluations("chess")


def test_a_call_that_comes_again_asks_for_nothing(registry: Registry) -> None:
    key, _ = registry.create_key("bot", ["evaluate"])
    call = Call(owner=key.id, key="first", digest="0" * 64)

    def again(call: Call) -> EvaluationRow:
        return registry.ask_evaluation(LEAGUE, ASKED, actor="bot", key=key.id, most=8, call=call)

    first = again(call)
    registry.claim_evaluation("a", 1)
    assert (again(call).id, again(call).state) == (first.id, "running")
    assert len(registry.evaluations(LEAGUE)) == 1
    with pytest.raises(KeyReused):
        again(replace(call, digest="1" * 64))
