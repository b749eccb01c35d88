"""Versions take part in matches of the environment that they were trained in, and of their own league."""

from pathlib import Path

import pytest

from evaluation.nightly import nightly
from evaluation.player import Player
from evaluation.schedule import round_robin
from evaluation.tournament import evaluate
from league.errors import EnvironmentMismatch, UnknownLeague
from league.policies.pinning import check_eligible, eligible, pinned
from league.registry.registry import Registry
from league.results.ledger import Ledger
from tests.evaluation import examples

LARGER = {"entry_point": "pettingzoo.classic.tictactoe_v3", "kwargs": {"screen_height": 500}}
NAMED = (
    r"tictactoe@1 was trained in another environment \(\w{12}\) than tictactoe has now \(\w{12}\), with kwargs \{\} "
)


@pytest.fixture
def registry(tmp_path: Path) -> Registry:
    """Version 1 is of the environment that the league had before, versions 2 and 3 of the one that it has now."""
    opened = examples.registry(tmp_path, play={"opening_plies": 2, "copies": 4})
    examples.publish(opened, examples.graph(wins=True))
    row = opened.league(examples.LEAGUE)
    changed = examples.config(environment=LARGER, play={"opening_plies": 2, "copies": 4}, gate={"max_blocks": 4})
    opened.register(changed, row.interface)
    for _ in range(2):
        examples.publish(opened, examples.graph(wins=True, blocks=True))
    return opened


def test_those_of_another_environment_are_left_out_where_nobody_is_named(registry: Registry) -> None:
    assert [version.ref for version in eligible(registry, examples.LEAGUE)] == ["tictactoe@2", "tictactoe@3"]
    report = evaluate(examples.LEAGUE, registry=registry, blocks=2)
    refs = {standing.ref for standing in report.standings}
    assert refs == {"tictactoe@2", "tictactoe@3", "script:random", "script:one_ply"}
    with pytest.raises(UnknownLeague):
        eligible(registry, "chess")


def test_one_that_is_named_is_refused_with_what_differs(registry: Registry) -> None:
    with pytest.raises(EnvironmentMismatch, match=NAMED + r"instead of \{'screen_height': 500\}"):
        evaluate(examples.LEAGUE, ["tictactoe@1", "tictactoe@2"], registry=registry)
    assert Ledger(registry).schedules(examples.LEAGUE) == []
    row = registry.league(examples.LEAGUE)
    for ref in ("tictactoe@2", "script:random"):
        check_eligible(ref, registry, row.config)


def test_whoever_drew_the_schedule_up_it_is_not_played(registry: Registry) -> None:
    row = registry.league(examples.LEAGUE)
    schedule = round_robin(row.config, row.interface, ["tictactoe@1", "tictactoe@2"], 2)
    with pytest.raises(EnvironmentMismatch, match=NAMED):
        Player(row.config, registry).play(schedule, [0])


def test_a_champion_of_another_environment_is_a_fault_that_says_so(registry: Registry) -> None:
    """It stays where it is, nobody is judged against it, and whoever can be rated is."""
    registry.set_alias(examples.LEAGUE, "champion", 1, expected=None, actor="me", reason="test")
    report = nightly(registry.league(examples.LEAGUE).config, registry=registry)
    assert (report.champion, report.verdicts) == ("tictactoe@1", ())
    assert {fault.partition(":")[0] for fault in report.faults} >= {
        "tictactoe@2 against tictactoe@1",
        "tictactoe@3 against tictactoe@1",
    }
    assert all("tictactoe@1 was trained in another environment" in fault for fault in report.faults)
    rated = {standing.ref for standing in report.standings if standing.rating is not None}
    assert rated == {"tictactoe@2", "tictactoe@3", "script:random", "script:one_ply"}


def test_a_version_of_another_league_is_refused(registry: Registry) -> None:
    row = registry.league(examples.LEAGUE)
    other = examples.config(league="elsewhere", environment=LARGER)
    registry.register(other, row.interface)
    examples.publish(registry, examples.graph(), "elsewhere")
    with pytest.raises(EnvironmentMismatch, match="elsewhere@1 is not a version of league tictactoe"):
        pinned("elsewhere@1", examples.LEAGUE, registry)
    schedule = round_robin(row.config, row.interface, ["elsewhere@1", "tictactoe@2"], 2)
    with pytest.raises(EnvironmentMismatch, match="elsewhere@1 is not a version of league tictactoe"):
        Player(row.config, registry).play(schedule, [0])
