"""The change token of a league changes with its data, and not with that of other leagues."""

from collections.abc import Callable
from datetime import UTC, datetime

import pytest

from league.errors import UnknownLeague
from league.refs import CheckpointRef
from league.registry.aliases import ANY
from league.registry.registry import Registry
from league.registry.storage.rows import Portion, RunPoint
from tests.support.leagues.acknowledgements import acknowledge
from tests.support.leagues.registries import LEAGUE, publish, registered


def begin_run(registry: Registry) -> None:
    registry.runs.begin(LEAGUE, "first", algorithm="ppo", settings={}, seed=0, target=9)


CHANGES: list[Callable[[Registry], object]] = [
    lambda registry: publish(registry, "run/1"),
    lambda registry: registry.aliases.set(LEAGUE, "champion", 1, expected=ANY, actor="test", reason="test"),
    lambda registry: registry.aliases.set(LEAGUE, "candidate", 1, expected=ANY, actor="test", reason="test"),
    lambda registry: registry.versions.set_note(CheckpointRef(LEAGUE, 1), "a try", actor="test"),
    lambda registry: registry.traffic.set(LEAGUE, shadow=Portion(1, 0.5), actor="test", reason="test"),
    lambda registry: acknowledge(registry, "replica-1", LEAGUE, 1, "0" * 64),
    lambda registry: acknowledge(registry, "replica-2", LEAGUE, 1, "0" * 64),
    lambda registry: registry.verdicts.open(LEAGUE, 1, "script:random", "s1", {}),
    lambda registry: registry.verdicts.close("s1", "reject", {}),
    lambda registry: registry.verdicts.void("s1", "by mistake"),
    lambda registry: registry.evaluations.submit(LEAGUE, {"kind": "tournament"}, actor="test", max_active=9),
    lambda registry: registry.evaluations.claim("runner", 1),
    lambda registry: registry.evaluations.heartbeat(1, "runner", {"what": "two", "played": 1, "of": 4}),
    lambda registry: registry.evaluations.finish(1, "runner", "done", result={}),
    begin_run,
    lambda registry: registry.runs.record(
        LEAGUE, "first", RunPoint(LEAGUE, "first", 3, {"return": 0.5}, datetime.now(UTC))
    ),
    lambda registry: registry.runs.end(LEAGUE, "first", "ended"),
    lambda registry: registry.snapshots.put(LEAGUE, {"summary": {}}, mark="a"),
]


def test_each_change_changes_the_token_of_its_league_only(registry: Registry) -> None:
    registered(registry, "chess")
    tokens, other = [registry.changes.token(LEAGUE)], registry.changes.token("chess")
    for change in CHANGES:
        change(registry)
        tokens.append(registry.changes.token(LEAGUE))
        assert tokens[-1] not in tokens[:-1]
        assert registry.changes.token(LEAGUE) == tokens[-1]
    assert registry.changes.token("chess") == other


def test_the_token_has_the_current_activity(registry: Registry) -> None:
    for change in CHANGES[:-2]:
        change(registry)
    token = registry.changes.token(LEAGUE)
    assert (token.aliases, token.version, token.serving) == ({"champion": 1, "candidate": 1}, 1, {1: 2})
    assert (token.verdicts, token.evaluation, token.evaluations) == ({"void": 1}, 1, ())
    assert (token.run, [(run.id, run.state, run.steps) for run in token.runs]) == ("first", [("first", "running", 3)])
    number = registry.evaluations.submit(LEAGUE, {"kind": "nightly"}, actor="test", max_active=9).id
    registry.runs.end(LEAGUE, "first", "failed", "no reason")
    token = registry.changes.token(LEAGUE)
    assert [(row.id, row.state) for row in token.evaluations] == [(number, "queued")]
    assert (token.run, token.runs) == ("first", ())


def test_an_unknown_league_has_no_token(registry: Registry) -> None:
    with pytest.raises(UnknownLeague):
        registry.changes.token("nobody")
