"""Two training runs side by side."""

from dataclasses import replace
from pathlib import Path

import pytest

from evaluation.reporting.run_comparison import compare_runs
from league.errors import InvalidReference, UnknownRun
from league.registry.registry import Registry
from league.registry.storage.rows import RunPoint
from league.results.ledger import Ledger
from league.settings import Storage
from tests.support.leagues.ledger_matches import SCHEDULE, play_match
from tests.support.leagues.registries import LEAGUE, publish, registered

FIRST, SECOND = "20261124-080000-aa", "20261124-080000-ab"
SETTINGS = {"lr": 0.001, "gamma": 0.99, "opponents": {"fixed": [], "league": {"share": 0.4}}}


@pytest.fixture
def registry(tmp_path: Path) -> Registry:
    """Two runs with one version each, and a run of another league that has published nothing."""
    registry = registered(registered(Registry.open(Storage.at(tmp_path / "home"))), "another")
    other = SETTINGS | {"lr": 0.0005, "opponents": {"fixed": [], "league": {"share": 0.2}}}
    for league, run, settings in ((LEAGUE, FIRST, SETTINGS), (LEAGUE, SECOND, other), ("another", FIRST, SETTINGS)):
        registry.runs.begin(league, run, algorithm="ppo", settings=settings, seed=1, target=9000)
        at = registry.runs.get(league, run).began_at
        registry.runs.record(
            league, run, RunPoint(league, run, 6000, {"return": 0.5, f"loss of {run}": 2.0}, at), seconds=3.0
        )
    for run in (FIRST, SECOND):
        publish(registry, f"{run}/6000")
    return registry


def test_settings_curves_and_speed_are_compared(registry: Registry) -> None:
    found = compare_runs(registry, f"{LEAGUE}/{FIRST}", SECOND)
    assert found.settings == {"lr": (0.001, 0.0005), "opponents.league.share": (0.4, 0.2)}
    assert found.curves == {"return": (0.5, 0.5), f"loss of {FIRST}": (2.0, None), f"loss of {SECOND}": (None, 2.0)}
    assert [run.actions_per_second for run in found.runs] == [2000.0, 2000.0]
    assert [run.versions for run in found.runs] == [(f"{LEAGUE}@1",), (f"{LEAGUE}@2",)]
    assert found.between is None


def test_games_between_the_last_versions_are_scored(registry: Registry) -> None:
    row = registry.leagues.get(LEAGUE)
    schedule = replace(
        SCHEDULE,
        contestants=(f"{LEAGUE}@2", f"{LEAGUE}@1"),
        pairings=((0, 1),),
        game_digest=row.conditions.game_digest,
    )
    ledger = Ledger(registry)
    ledger.open(schedule)
    for position in (0, 1):
        ledger.append(play_match(schedule, position))
    between = compare_runs(registry, f"{LEAGUE}/{FIRST}", SECOND).between
    assert between is not None
    assert (between.first, between.second) == (f"{LEAGUE}@1", f"{LEAGUE}@2")
    assert (between.score, between.games) == (0.25, 4), "contestant 0 of the schedule wins one game and draws one"
    assert between.interval[0] < 0.25 < between.interval[1]
    assert compare_runs(registry, SECOND, f"another/{FIRST}").between is None


def test_runs_are_found_by_a_unique_beginning(registry: Registry) -> None:
    assert registry.runs.find("20261124-080000-ab").id == SECOND
    assert registry.runs.find("another/2026").league == "another"
    with pytest.raises(InvalidReference, match=f"is ambiguous: .*{LEAGUE}/{FIRST}"):
        registry.runs.find(FIRST)
    for text in ("", "2027", f"chess/{FIRST}", "%"):
        with pytest.raises(UnknownRun, match="there is no training run"):
            registry.runs.find(text)
