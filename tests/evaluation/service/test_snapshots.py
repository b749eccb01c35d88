"""Snapshots are what the ledger contains, also of earlier games, and are recomputed only after changes."""

import logging
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaluation.gating import evidence
from evaluation.gating.evidence import verdict_of
from evaluation.gating.verdicts import open_verdict, void
from evaluation.matches.game_records import unique_games
from evaluation.matches.leaderboard import MAX_UPSETS, compute_leaderboard
from evaluation.matches.tournament import evaluate
from evaluation.service import snapshots
from evaluation.service.snapshots import EarlierResults, documents, earlier_results, refresh, thinned
from evaluation.statistics.payoff import tabulate
from league.conditions import GameChange
from league.environments.building import interface
from league.errors import AlreadyRunning, UnknownLeague
from league.registry.registry import Registry
from league.registry.snapshots import earlier_part
from league.registry.storage.rows import SnapshotRow
from league.results.ledger import Ledger
from league.results.sums import tally
from tests.support.leagues import reported_league, tictactoe
from tests.support.leagues.judged_league import reconfigure
from tests.support.leagues.tictactoe import LEAGUE
from tests.support.templates import copied

PARTS = {"summary", "leaderboard", "payoff", "ratings"}


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A league after a nightly run, with its snapshots."""
    home = tmp_path_factory.mktemp("home")
    with reported_league.league_after_nightly(home) as opened:
        refresh(opened, LEAGUE)
    return home


@pytest.fixture
def registry(home: Path, tmp_path: Path) -> Iterator[Registry]:
    """A copy of the league that a test may change."""
    with copied(home, tmp_path / "home") as opened:
        yield opened


def snapshot(registry: Registry, part: str) -> SnapshotRow:
    row = registry.snapshots.get(LEAGUE, part)
    assert row is not None
    return row


def times(registry: Registry) -> dict[str, datetime]:
    return {part: snapshot(registry, part).at for part in registry.snapshots.marks(LEAGUE)}


def test_the_summary_counts_the_games_of_the_ledger(registry: Registry) -> None:
    matches, row = Ledger(registry).matches(league=LEAGUE), registry.leagues.get(LEAGUE)
    summary = dict(snapshot(registry, "summary").document)
    upsets = summary.pop("upsets")
    assert summary == {
        "games": sum(len(match.games) for match in matches),
        "matches": len(matches),
        "unique_games": unique_games(matches),
        "scoring": "game",
        "actions": "greedy",
        "sides": ["player_1", "player_2"],
        "environment": "pettingzoo.classic.tictactoe_v3",
        "environment_digest": row.environment_digest,
        "earlier": [],
    }
    ratings = {standing.ref: standing.rating or 0.0 for standing in compute_leaderboard(registry, LEAGUE)}
    assert 0 < len(upsets) <= MAX_UPSETS
    for upset in upsets:
        assert ratings[upset["better"]] < ratings[upset["other"]]
        assert upset["score"] in Ledger(registry).match(upset["match"]).games[upset["game"]].scores


def test_the_leaderboard_and_the_payoffs_are_those_of_the_ledger(registry: Registry) -> None:
    matches = Ledger(registry).matches(league=LEAGUE)
    expected = [
        replace(standing, unique_games=unique_games(matches, standing.ref)).to_json()
        for standing in compute_leaderboard(registry, LEAGUE)
    ]
    assert snapshot(registry, "leaderboard").document == {
        "sides": ["player_1", "player_2"],
        "leaderboard": expected,
        "by_side": {},
        "not_champion": None,
    }
    refs = [standing["ref"] for standing in expected]
    payoff = dict(snapshot(registry, "payoff").document)
    shares = payoff.pop("shares")
    assert payoff == tabulate(refs, ["player_1", "player_2"], tally(matches)).to_json()
    assert {share["ref"] for share in shares} == set(refs), "a round robin has all pairs"
    assert sum(share["nash"] for share in shares) == pytest.approx(1)
    versions = snapshot(registry, "ratings").document["versions"]
    assert [version["number"] for version in versions] == [1, 2, 3]
    ratings = {standing["ref"]: standing["rating"] for standing in expected}
    assert [version["rating"] for version in versions] == [ratings[version["ref"]] for version in versions]
    assert [len(version["champion_at"]) for version in versions] == [1, 1, 2], "a rollback promotes version 3 again"


def test_each_verdict_has_its_evidence(registry: Registry) -> None:
    rows = registry.verdicts.all(LEAGUE)
    assert registry.snapshots.marks(LEAGUE).keys() == PARTS | {f"verdict/{row.id}" for row in rows}
    for row in rows:
        evidence = verdict_of(registry, row).to_json()
        assert (evidence["outcome"], evidence["promoted"]) == (row.outcome, row.evidence["promoted"])
        assert (evidence["llr"], evidence["blocks"]) == (row.evidence["llr"], row.evidence["blocks"])
        assert evidence["counts"] == row.evidence["counts"]
        evidence["curve"] = [[block, llr] for block, llr in enumerate(evidence["curve"], start=1)]
        assert snapshot(registry, f"verdict/{row.id}").document == evidence
    reasons = [snapshot(registry, f"verdict/{row.id}").document["reason"] for row in rows]
    assert reasons[0].startswith("Not stronger: ")
    assert reasons[-1].startswith("Stronger: ")


def test_current_snapshots_are_recomputed_after_a_rollback(registry: Registry) -> None:
    times_before = times(registry)
    assert registry.snapshots.stale() == []
    refresh(registry, LEAGUE)
    assert times(registry) == times_before
    registry.aliases.rollback(LEAGUE, actor="ada", reason="it was slow")
    refresh(registry, LEAGUE)
    assert "it was rolled back" in snapshot(registry, "leaderboard").document["not_champion"]


def test_new_games_change_the_standings_but_not_closed_verdicts(registry: Registry) -> None:
    times_before, games = times(registry), snapshot(registry, "summary").document["games"]
    played = evaluate(LEAGUE, ["tictactoe@1", "script:random"], registry=registry, blocks=4, seed=9)
    assert registry.snapshots.stale() == [LEAGUE]
    refresh(registry, LEAGUE)
    times_after = times(registry)
    assert registry.snapshots.stale() == []
    assert {part for part in times_after if times_after[part] != times_before[part]} == PARTS
    assert snapshot(registry, "summary").document["games"] == games + played.games


def test_a_verdict_is_recomputed_until_it_is_closed_and_when_voided(registry: Registry) -> None:
    verdict = open_verdict(registry, registry.leagues.get(LEAGUE), 1, "tictactoe@3", alpha=0.001)

    def refreshed() -> dict[str, Any]:
        refresh(registry, LEAGUE)
        return snapshot(registry, f"verdict/{verdict.id}").document

    opened = refreshed()
    assert (opened["outcome"], opened["curve"]) == ("open", [])
    registry.verdicts.close(verdict.id, "inconclusive", {"note": "nobody has played"})
    closed = refreshed()
    assert (closed["outcome"], closed["reason"]) == ("inconclusive", "Inconclusive: nobody has played.")
    void(registry, verdict.id, actor="ada", reason="a mistake")
    voided = refreshed()
    assert (voided["outcome"], voided["reason"]) == ("void", "Void: voided by ada: a mistake.")


def test_a_league_without_matches_has_all_parts(tmp_path: Path) -> None:
    with reported_league.empty(tmp_path) as registry:
        assert registry.snapshots.stale() == [LEAGUE]
        refresh(registry, LEAGUE)
        assert registry.snapshots.marks(LEAGUE).keys() == PARTS
        assert registry.snapshots.stale() == []
        assert snapshot(registry, "ratings").document == {"versions": []}
        with pytest.raises(UnknownLeague, match="chess"):
            refresh(registry, "chess")


def test_different_sides_have_their_own_standings(tmp_path: Path) -> None:
    with reported_league.league_with_roles(tmp_path) as registry:
        content = documents(registry, LEAGUE)
    assert content["summary"]["scoring"] == "side"
    assert list(content["leaderboard"]["by_side"]) == ["adversary", "good"]
    assert {standing["games"] for standing in content["leaderboard"]["by_side"]["good"]} == {10}


def test_the_longest_waiting_leagues_are_refreshed_first(registry: Registry) -> None:
    for name in ("never", "long-ago", "up-to-date"):
        config = tictactoe.config(league=name)
        registry.leagues.register(config, interface(config))
    registry.snapshots.put("long-ago", {"summary": {}}, mark="of another time")
    registry.snapshots.put("up-to-date", {"summary": {}}, mark=registry.snapshots.current_marks()["up-to-date"])
    registry.snapshots.put(LEAGUE, {"summary": {}}, mark="of another time")
    assert registry.snapshots.stale() == ["never", "long-ago", LEAGUE]


def test_a_refresh_is_exclusive_and_changes_all_or_nothing(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    with closing(Registry.open(registry.storage)) as other, other.exclusive_lock(f"snapshots-{LEAGUE}"):  # noqa: SIM117
        with pytest.raises(AlreadyRunning):
            refresh(registry, LEAGUE)
    previous = {part: snapshot(registry, part) for part in registry.snapshots.marks(LEAGUE)}
    registry.aliases.rollback(LEAGUE, actor="ada", reason="test")

    def abort(*_: object) -> Any:
        raise SystemExit("power cut")

    with monkeypatch.context() as patched:
        patched.setattr(snapshots, "rated_version", abort)
        with pytest.raises(SystemExit):
            refresh(registry, LEAGUE)
    assert {part: snapshot(registry, part) for part in registry.snapshots.marks(LEAGUE)} == previous
    assert registry.snapshots.stale() == [LEAGUE]
    refresh(registry, LEAGUE)
    assert registry.snapshots.stale() == []


def test_a_failing_verdict_does_not_affect_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    with reported_league.empty(tmp_path) as registry:
        tictactoe.publish(registry, tictactoe.graph())
        row = registry.leagues.get(LEAGUE)
        first, second = (open_verdict(registry, row, 1, f"script:{name}") for name in ("random", "one_ply"))

        def fail_for_second(registry: Registry, verdict: Any) -> Any:
            if verdict.id == second.id:
                raise ZeroDivisionError
            return verdict_of(registry, verdict)

        monkeypatch.setattr(evidence, "verdict_of", fail_for_second)
        with caplog.at_level(logging.ERROR):
            refresh(registry, LEAGUE)
        assert registry.snapshots.marks(LEAGUE).keys() == PARTS | {f"verdict/{first.id}"}
    assert f"verdict {second.id} has no snapshot" in caplog.text


@given(st.integers(0, 1000), st.integers(2, 20))
def test_a_curve_is_thinned_to_a_limited_number_of_points(blocks: int, most: int) -> None:
    points = thinned([block / 2 for block in range(1, blocks + 1)], most=most)
    assert len(points) == min(blocks, most)
    assert all(llr == block / 2 for block, llr in points)
    assert [block for block, _ in points] == sorted({block for block, _ in points})
    if blocks:
        assert (points[0][0], points[-1][0]) == (1, blocks)


OLD = {"opening_plies": 2, "num_envs": 4}


@pytest.fixture
def small(tmp_path: Path) -> Iterator[Registry]:
    """A league with four matches."""
    with closing(tictactoe.registry(tmp_path / "small", play=OLD)) as opened:
        tictactoe.publish(opened, tictactoe.graph(wins=True))
        evaluate(LEAGUE, registry=opened, schedule="gauntlet", against=["script:random"], blocks=4)
        yield opened


def change(registry: Registry, **play: object) -> None:
    reconfigure(registry, tictactoe.config(play=OLD | play))


def earlier(registry: Registry) -> list[EarlierResults]:
    return earlier_results(registry, registry.leagues.get(LEAGUE))


def test_tables_before_and_after_a_change_are_kept_apart(small: Registry) -> None:
    refresh(small, LEAGUE)
    before, payoff = snapshot(small, "leaderboard"), snapshot(small, "payoff")
    change(small, opening_plies=4)
    assert small.snapshots.stale() == [LEAGUE]
    refresh(small, LEAGUE)
    assert snapshot(small, "payoff").document is None
    assert [version["rating"] for version in snapshot(small, "ratings").document["versions"]] == [None]
    (results,) = earlier(small)
    assert results.changes == (GameChange("play.opening_plies", "2", "4"),)
    assert (results.matches, results.actions_changed, results.replaced_at is None) == (4, False, False)
    summary, current = snapshot(small, "summary"), snapshot(small, "leaderboard")
    assert summary.document["earlier"] == [results.to_json()]
    assert (summary.document["matches"], current.document["leaderboard"]) == (0, [])
    assert "there is no champion: it has not been tested" in before.document["not_champion"]
    leaderboard = before.document | {"not_champion": None}  # the champion is that of the current game
    for part, document in (("leaderboard", leaderboard), ("payoff", payoff.document)):
        assert snapshot(small, earlier_part(results.conditions.name, part)).document == document


def test_only_results_of_another_game_or_selection_of_actions_are_earlier_ones(small: Registry) -> None:
    change(small, num_envs=2)
    assert earlier(small) == []
    change(small, opening_plies=4)
    change(small)
    assert earlier(small) == [], "a game that returns counts again"
    assert [game.game["play.opening_plies"] for game in small.leagues.earlier_games(LEAGUE)] == [4]
    change(small, actions="sampled")
    (results,) = earlier(small)
    assert (results.conditions.actions, results.actions_changed, results.changes) == ("greedy", True, ())


def test_a_game_without_results_is_recorded(small: Registry) -> None:
    """A worker that has the configuration from before a change records its matches afterwards."""
    change(small, opening_plies=3)
    change(small, opening_plies=4)
    evaluate(LEAGUE, registry=small, schedule="gauntlet", against=["script:random"], blocks=2)
    change(small, opening_plies=5)
    assert {results.matches: results.changes for results in earlier(small)} == {
        4: (GameChange("play.opening_plies", "2", "5"),),
        2: (GameChange("play.opening_plies", "4", "5"),),
    }
