"""Versions play only in the environment in which they were trained, and in their own league."""

from pathlib import Path

import pytest

from evaluation.gating.nightly import nightly
from evaluation.matches.tournament import evaluate
from evaluation.matches.worker import MatchWorker
from evaluation.schedules.builders import round_robin
from league.errors import EnvironmentMismatch, UnknownLeague
from league.policies.loading import check_eligible, eligible, pinned
from league.registry.registry import Registry
from league.results.ledger import Ledger
from tests.support.leagues import tictactoe

LARGER = {"entry_point": "pettingzoo.classic.tictactoe_v3", "kwargs": {"screen_height": 500}}
MISMATCH = (
    r"tictactoe@1 was trained in another environment \(\w{12}\) than tictactoe has now \(\w{12}\), with kwargs \{\} "
)


@pytest.fixture
def registry(tmp_path: Path) -> Registry:
    """Version 1 was trained in an earlier environment of the league, versions 2 and 3 in its current one."""
    opened = tictactoe.registry(tmp_path, play={"opening_plies": 2, "num_envs": 4})
    tictactoe.publish(opened, tictactoe.graph(wins=True))
    row = opened.leagues.get(tictactoe.LEAGUE)
    changed = tictactoe.config(environment=LARGER, play={"opening_plies": 2, "num_envs": 4}, gate={"max_blocks": 4})
    opened.leagues.register(changed, row.interface)
    for _ in range(2):
        tictactoe.publish(opened, tictactoe.graph(wins=True, blocks=True))
    return opened


def test_versions_of_another_environment_are_not_selected(registry: Registry) -> None:
    assert [version.ref for version in eligible(registry, tictactoe.LEAGUE)] == ["tictactoe@2", "tictactoe@3"]
    report = evaluate(tictactoe.LEAGUE, registry=registry, blocks=2)
    refs = {standing.ref for standing in report.leaderboard}
    assert refs == {"tictactoe@2", "tictactoe@3", "script:random", "script:one_ply"}
    with pytest.raises(UnknownLeague):
        eligible(registry, "chess")


def test_a_requested_version_of_another_environment_is_rejected(registry: Registry) -> None:
    with pytest.raises(EnvironmentMismatch, match=MISMATCH + r"instead of \{'screen_height': 500\}"):
        evaluate(tictactoe.LEAGUE, ["tictactoe@1", "tictactoe@2"], registry=registry)
    assert Ledger(registry).schedules(tictactoe.LEAGUE) == []
    row = registry.leagues.get(tictactoe.LEAGUE)
    for ref in ("tictactoe@2", "script:random"):
        check_eligible(ref, registry, row.config)


def test_a_schedule_with_a_version_of_another_environment_is_rejected(registry: Registry) -> None:
    row = registry.leagues.get(tictactoe.LEAGUE)
    schedule = round_robin(row.config, row.interface, ["tictactoe@1", "tictactoe@2"], 2)
    with pytest.raises(EnvironmentMismatch, match=MISMATCH):
        MatchWorker(row.config, registry).play(schedule, [0])


def test_a_champion_of_another_environment_is_reported_as_a_fault(registry: Registry) -> None:
    """It remains champion, no candidate is compared with it, and all other versions are rated."""
    registry.aliases.set(tictactoe.LEAGUE, "champion", 1, expected=None, actor="me", reason="test")
    report = nightly(registry.leagues.get(tictactoe.LEAGUE).config, registry=registry)
    assert (report.champion, report.verdicts) == ("tictactoe@1", ())
    assert {fault.partition(":")[0] for fault in report.faults} >= {
        "tictactoe@2 against tictactoe@1",
        "tictactoe@3 against tictactoe@1",
    }
    assert all("tictactoe@1 was trained in another environment" in fault for fault in report.faults)
    rated = {standing.ref for standing in report.leaderboard if standing.rating is not None}
    assert rated == {"tictactoe@2", "tictactoe@3", "script:random", "script:one_ply"}


def test_a_version_of_another_league_is_rejected(registry: Registry) -> None:
    row = registry.leagues.get(tictactoe.LEAGUE)
    other = tictactoe.config(league="elsewhere", environment=LARGER)
    registry.leagues.register(other, row.interface)
    tictactoe.publish(registry, tictactoe.graph(), "elsewhere")
    with pytest.raises(EnvironmentMismatch, match="elsewhere@1 is not a version of league tictactoe"):
        pinned("elsewhere@1", tictactoe.LEAGUE, registry)
    schedule = round_robin(row.config, row.interface, ["elsewhere@1", "tictactoe@2"], 2)
    with pytest.raises(EnvironmentMismatch, match="elsewhere@1 is not a version of league tictactoe"):
        MatchWorker(row.config, registry).play(schedule, [0])
