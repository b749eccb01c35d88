"""Why the best version is not the champion, doubts before a promotion by hand, and runs side by side."""

from dataclasses import replace
from pathlib import Path

import pytest

from evaluation.documents import Standing
from evaluation.gating.verdicts import open_verdict, void
from evaluation.matches.tournament import evaluate
from evaluation.reporting.gate_record import doubts, why_not_champion
from evaluation.reporting.run_comparison import compare_runs
from league.errors import InvalidReference, UnknownRun
from league.refs import CheckpointRef
from league.registry.registry import Registry
from league.registry.storage.rows import RunPoint
from league.results.ledger import Ledger
from league.settings import Storage
from tests.support.leagues import registries, tictactoe
from tests.support.leagues.judged_league import CONFIG, MIDDLING, STRONG, WEAK, league_of, promote, reconfigure
from tests.support.leagues.ledger_matches import SCHEDULE, play_match
from tests.support.leagues.registries import registered
from tests.support.leagues.tictactoe import LEAGUE


@pytest.fixture
def registry(tmp_path: Path) -> Registry:
    """Version 1 is the champion."""
    return promote(league_of(tmp_path, WEAK, MIDDLING, STRONG), 1)


def standing(ref: str, rating: float | None, half: float = 10.0) -> Standing:
    interval = None if rating is None else (rating - half, rating + half)
    return Standing(ref, None, 0.5, 100, None, rating, interval)


BEST = (standing("script:minimax_2", 300), standing("tictactoe@3", 200), standing("tictactoe@1", 100))


def closed(registry: Registry, candidate: int, outcome: str, **evidence: object) -> str:
    verdict = open_verdict(registry, registry.leagues.get(LEAGUE), candidate, "tictactoe@1")
    registry.verdicts.close(verdict.id, outcome, evidence)
    return verdict.short_id


CHANGED = tictactoe.config(play={"opening_plies": 3}, gate=CONFIG.gate.model_dump())


def test_nothing_is_explained_if_the_champion_is_best_or_nothing_is_rated(registry: Registry) -> None:
    assert why_not_champion(registry, LEAGUE, BEST[2:]) is None
    assert why_not_champion(registry, LEAGUE, ()) is None
    assert why_not_champion(registry, LEAGUE, (BEST[0], BEST[2], BEST[1])) is None, "a script cannot be champion"
    assert why_not_champion(registry, LEAGUE, (standing("tictactoe@3", None), BEST[2])) is None


def test_a_version_that_was_not_tested(registry: Registry) -> None:
    assert why_not_champion(registry, LEAGUE, BEST) == (
        "tictactoe@3 is the best version by rating, but the champion is tictactoe@1: it has not been tested:"
        " `league nightly tictactoe` tests it."
    )
    wide = (standing("tictactoe@3", 200, 80), standing("tictactoe@1", 100, 80))
    assert str(why_not_champion(registry, LEAGUE, wide)).endswith("; their 95 % intervals overlap.")
    unrated = (BEST[1], standing("tictactoe@1", None))
    assert "the champion is not rated under the current conditions" in str(why_not_champion(registry, LEAGUE, unrated))
    registry.removal.remove_version(CheckpointRef(LEAGUE, 1), force=True)
    assert str(why_not_champion(registry, LEAGUE, BEST[1:2])).startswith(
        "tictactoe@3 is the best version by rating, but there is no champion: it has not been tested"
    )


def test_a_version_that_the_gate_did_not_promote(registry: Registry) -> None:
    verdict = open_verdict(registry, registry.leagues.get(LEAGUE), 3, "tictactoe@1")
    assert f"verdict {verdict.short_id} on it is open" in str(why_not_champion(registry, LEAGUE, BEST))
    registry.verdicts.close(verdict.id, "reject", {"note": "it is weaker than a bot"})
    rejected = str(why_not_champion(registry, LEAGUE, BEST))
    assert f"it was rejected in verdict {verdict.short_id}: it is weaker than a bot." in rejected
    void(registry, verdict.id, actor="ada", reason="a mistake")
    assert "did not count: voided by ada: a mistake; the next nightly run tests it again" in str(
        why_not_champion(registry, LEAGUE, BEST)
    )
    name = closed(registry, 3, "inconclusive")
    inconclusive = str(why_not_champion(registry, LEAGUE, BEST))
    assert f"verdict {name} on it was inconclusive: it did not pass the test against tictactoe@1." in inconclusive


def test_a_version_under_other_conditions_or_that_was_champion(registry: Registry) -> None:
    name = closed(registry, 3, "reject")
    reconfigure(registry, CHANGED)
    hint = f"has changed since, and after `league void {name}` the next nightly run tests it again."
    assert hint in why_not_champion(registry, LEAGUE, BEST)
    promote(registry, 3, 1)
    assert "it was replaced by tictactoe@1 on " in why_not_champion(registry, LEAGUE, BEST)
    promote(registry, 3).aliases.rollback(LEAGUE, actor="ada", reason="it was slow")
    rolled_back = why_not_champion(registry, LEAGUE, BEST)
    assert "it was rolled back on " in rolled_back
    assert "by ada (it was slow)" in rolled_back


def test_doubts_about_a_promotion_by_hand(registry: Registry) -> None:
    """A mixture has played if its members have."""
    first, second, _ = registry.versions.all(LEAGUE)
    mixture = registry.publisher.publish_mixture(LEAGUE, {1: 0.5, 3: 0.5})
    assert "tictactoe@1, tictactoe@3 have played no game" in doubts(registry, mixture)
    assert "tictactoe@2 has played no game under the current conditions" in doubts(registry, second)
    evaluate(LEAGUE, ["tictactoe@1", "tictactoe@2", "tictactoe@3"], registry=registry, blocks=2)
    assert doubts(registry, second) is doubts(registry, mixture) is None
    closed(registry, 2, "reject", reason="Not stronger: it scored 40.0 %.")
    assert "the gate has rejected tictactoe@2 in verdict" in doubts(registry, second)
    assert doubts(registry, second).endswith(": Not stronger: it scored 40.0 %")
    reconfigure(registry, CHANGED)
    assert "has played no game" in doubts(registry, first), "the game has changed"


SETTINGS = {"lr": 0.001, "gamma": 0.99, "opponents": {"fixed": [], "league": {"share": 0.4}}}


FIRST, SECOND = "20261124-080000-aa", "20261124-080000-ab"


@pytest.fixture
def with_runs(tmp_path: Path) -> Registry:
    """Two runs with one version each, and a run of another league that has published nothing."""
    registry = registered(registered(Registry.open(Storage.at(tmp_path / "home"))), "another")
    other = SETTINGS | {"lr": 0.0005, "opponents": {"fixed": [], "league": {"share": 0.2}}}
    for league, run, values in ((LEAGUE, FIRST, SETTINGS), (LEAGUE, SECOND, other), ("another", FIRST, SETTINGS)):
        registry.runs.begin(league, run, algorithm="ppo", settings=values, seed=1, target=9000)
        began_at = registry.runs.get(league, run).began_at
        point = RunPoint(league, run, 6000, {"return": 0.5, f"loss of {run}": 2.0}, began_at)
        registry.runs.record(league, run, point, seconds=3.0)
    for run in (FIRST, SECOND):
        registries.publish(registry, f"{run}/6000")
    return registry


def test_settings_curves_speed_and_games_of_two_runs_are_compared(with_runs: Registry) -> None:
    comparison = compare_runs(with_runs, f"{LEAGUE}/{FIRST}", SECOND)
    assert comparison.settings == {"lr": (0.001, 0.0005), "opponents.league.share": (0.4, 0.2)}
    losses = {f"loss of {FIRST}": (2.0, None), f"loss of {SECOND}": (None, 2.0)}
    assert comparison.curves == {"return": (0.5, 0.5)} | losses
    assert [run.actions_per_second for run in comparison.runs] == [2000.0, 2000.0]
    assert [run.versions for run in comparison.runs] == [(f"{LEAGUE}@1",), (f"{LEAGUE}@2",)]
    assert comparison.between is None
    digest, refs = with_runs.leagues.get(LEAGUE).conditions.game_digest, (f"{LEAGUE}@2", f"{LEAGUE}@1")
    schedule = replace(SCHEDULE, contestants=refs, pairings=((0, 1),), game_digest=digest)
    ledger = Ledger(with_runs)
    ledger.open(schedule)
    for position in (0, 1):
        ledger.extend([play_match(schedule, position)])
    between = compare_runs(with_runs, f"{LEAGUE}/{FIRST}", SECOND).between
    assert (between.first, between.second) == (f"{LEAGUE}@1", f"{LEAGUE}@2")
    assert (between.score, between.games) == (0.25, 4), "contestant 0 of the schedule wins one game and draws one"
    assert between.interval[0] < 0.25 < between.interval[1]
    assert compare_runs(with_runs, SECOND, f"another/{FIRST}").between is None


def test_runs_are_found_by_a_unique_beginning(with_runs: Registry) -> None:
    assert with_runs.runs.find("20261124-080000-ab").id == SECOND
    assert with_runs.runs.find("another/2026").league == "another"
    with pytest.raises(InvalidReference, match=f"is ambiguous: .*{LEAGUE}/{FIRST}"):
        with_runs.runs.find(FIRST)
    for text in ("", "2027", f"chess/{FIRST}", "%"):
        with pytest.raises(UnknownRun, match="there is no training run"):
            with_runs.runs.find(text)
