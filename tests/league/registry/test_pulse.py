"""The pulse of a league is another whenever something of it is, and of no other league."""

from collections.abc import Callable
from datetime import UTC, datetime

import pytest

from league.errors import UnknownLeague
from league.refs import CheckpointRef
from league.registry.aliases import ANY
from league.registry.registry import Registry
from league.registry.rows import Portion, RunPoint
from tests.league.registry.examples import LEAGUE, publish, registered


def begin_run(registry: Registry) -> None:
    registry.begin_run(LEAGUE, "first", algorithm="ppo", settings={}, seed=0, target=9)


CHANGES: list[Callable[[Registry], object]] = [
    lambda registry: publish(registry, "run/1"),
    lambda registry: registry.set_alias(LEAGUE, "champion", 1, expected=ANY, actor="test", reason="test"),
    lambda registry: registry.set_alias(LEAGUE, "candidate", 1, expected=ANY, actor="test", reason="test"),
    lambda registry: registry.note(CheckpointRef(LEAGUE, 1), "a try", actor="test"),
    lambda registry: registry.set_traffic(LEAGUE, shadow=Portion(1, 0.5), actor="test", reason="test"),
    lambda registry: registry.acknowledge("replica-1", LEAGUE, 1, "0" * 64),
    lambda registry: registry.acknowledge("replica-2", LEAGUE, 1, "0" * 64),
    lambda registry: registry.open_verdict(LEAGUE, 1, "script:random", "s1", {}),
    lambda registry: registry.close_verdict("s1", "reject", {}),
    lambda registry: registry.void_verdict("s1", "by mistake"),
    lambda registry: registry.ask_evaluation(LEAGUE, {"kind": "tournament"}, actor="test", most=9),
    lambda registry: registry.claim_evaluation("runner", 1),
    lambda registry: registry.beat_evaluation(1, "runner", {"what": "two", "played": 1, "of": 4}),
    lambda registry: registry.finish_evaluation(1, "runner", "done", result={}),
    begin_run,
    lambda registry: registry.record_point(LEAGUE, "first", RunPoint(3, {"return": 0.5}, datetime.now(UTC))),
    lambda registry: registry.end_run(LEAGUE, "first", "ended"),
    lambda registry: registry.put_snapshots(LEAGUE, {"summary": {}}, mark="a"),
]


def test_each_change_is_felt_and_by_no_other_league(registry: Registry) -> None:
    registered(registry, "chess")
    seen, other = [registry.pulse(LEAGUE)], registry.pulse("chess")
    for change in CHANGES:
        change(registry)
        seen.append(registry.pulse(LEAGUE))
        assert seen[-1] not in seen[:-1]
        assert registry.pulse(LEAGUE) == seen[-1]
    assert registry.pulse("chess") == other


def test_it_says_what_is_under_way(registry: Registry) -> None:
    for change in CHANGES[:-2]:
        change(registry)
    pulse = registry.pulse(LEAGUE)
    assert (pulse.aliases, pulse.version, pulse.serving) == ({"champion": 1, "candidate": 1}, 1, {1: 2})
    assert (pulse.verdicts, pulse.evaluation, pulse.evaluations) == ({"void": 1}, 1, ())
    assert (pulse.run, [(run.id, run.state, run.steps) for run in pulse.runs]) == ("first", [("first", "running", 3)])
    number = registry.ask_evaluation(LEAGUE, {"kind": "nightly"}, actor="test", most=9).id
    registry.end_run(LEAGUE, "first", "failed", "no reason")
    pulse = registry.pulse(LEAGUE)
    assert [(row.id, row.state) for row in pulse.evaluations] == [(number, "queued")]
    assert (pulse.run, pulse.runs) == ("first", ())


def test_a_league_that_is_not_there_has_none(registry: Registry) -> None:
    with pytest.raises(UnknownLeague):
        registry.pulse("nobody")
