import json
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import pytest

from evaluation.gating.nightly import nightly
from evaluation.gating.verdicts import open_verdict
from evaluation.matches import leaderboard
from evaluation.matches.game_records import unique_games
from evaluation.matches.leaderboard import compute_leaderboard
from evaluation.reporting import league_report as module
from evaluation.reporting.league_report import LeagueReport, league_report
from evaluation.statistics.payoff import tabulate
from league.config.league import LeagueConfig
from league.environments.building import interface
from league.errors import UnknownLeague
from league.registry.registry import Registry
from league.results.ledger import Ledger
from tests.support.leagues import reported_league, tictactoe
from tests.support.leagues.tictactoe import LEAGUE

NOON = datetime(2026, 3, 3, 12, tzinfo=UTC)


@pytest.fixture(scope="module")
def registry(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Registry]:
    with reported_league.league_after_nightly(tmp_path_factory.mktemp("home")) as opened:
        yield opened


@pytest.fixture(scope="module")
def report(registry: Registry) -> LeagueReport:
    return league_report(registry, LEAGUE, pictures=False, now=NOON)


def test_the_header_has_the_number_of_games(registry: Registry, report: LeagueReport) -> None:
    matches = Ledger(registry).matches(league=LEAGUE)
    assert (report.league, report.champion, report.made_at) == (LEAGUE, "tictactoe@3", "2026-03-03T12:00:00Z")
    assert report.games == sum(len(match.games) for match in matches)
    assert report.unique_games == unique_games(matches) < report.games


def test_the_leaderboard_equals_the_computed_one(registry: Registry, report: LeagueReport) -> None:
    matches = Ledger(registry).matches(league=LEAGUE)
    for reported, expected in zip(report.leaderboard, compute_leaderboard(registry, LEAGUE), strict=True):
        assert (reported.ref, reported.rating, reported.interval, reported.games) == (
            expected.ref,
            expected.rating,
            expected.interval,
            expected.games,
        )
        assert reported.unique_games == unique_games(matches, reported.ref)
    assert report.by_side == {}


def test_the_payoff_table_covers_all_matches(registry: Registry, report: LeagueReport) -> None:
    refs = [standing.ref for standing in report.leaderboard]
    assert report.payoff == tabulate(refs, report.sides, Ledger(registry).matches(league=LEAGUE))
    assert {share.ref for share in report.shares} == set(refs), "a round robin has all pairs"
    assert sum(share.nash for share in report.shares) == pytest.approx(1)


def test_versions_have_ratings_and_times_of_promotion(report: LeagueReport) -> None:
    assert [version.number for version in report.versions] == [1, 2, 3]
    ratings = {standing.ref: standing.rating for standing in report.leaderboard}
    assert [version.rating for version in report.versions] == [ratings[version.ref] for version in report.versions]
    assert [len(version.champion_at) for version in report.versions] == [1, 1, 2], "a rollback promotes version 3 again"


def test_verdicts_are_listed_newest_first_with_their_curves(registry: Registry, report: LeagueReport) -> None:
    rows = registry.verdicts.all(LEAGUE)
    assert [verdict.verdict for verdict in report.verdicts] == [row.id for row in reversed(rows)]
    for verdict, row in zip(report.verdicts, reversed(rows), strict=True):
        assert row.evidence is not None
        assert verdict.outcome == row.outcome
        assert verdict.promoted == row.evidence["promoted"]
        assert (verdict.llr, verdict.blocks) == (row.evidence["llr"], row.evidence["blocks"])
        assert list(verdict.counts) == row.evidence["counts"]
        assert len(verdict.curve) == verdict.blocks
        assert verdict.curve[-1] == verdict.llr
        assert str(verdict.games) in verdict.reason
    stronger, weaker = report.verdicts[0], report.verdicts[-1]
    assert stronger.reason.startswith("Stronger: ")
    assert weaker.reason.startswith("Not stronger: ")


def test_promotions_have_kind_actor_and_reason(report: LeagueReport) -> None:
    assert [(event.kind, event.champion, event.before) for event in report.promotions] == [
        ("rollback", "tictactoe@3", "tictactoe@1"),
        ("by hand", "tictactoe@1", "tictactoe@3"),
        ("promotion", "tictactoe@3", "tictactoe@2"),
        ("promotion", "tictactoe@2", None),
    ]
    assert report.promotions[1].reason == reported_league.HOSTILE
    assert report.promotions[2].verdict == report.verdicts[0].verdict


def test_upsets_are_games_in_which_the_weaker_contestant_did_better(registry: Registry, report: LeagueReport) -> None:
    ratings = {standing.ref: standing.rating or 0.0 for standing in report.leaderboard}
    assert 0 < len(report.upsets) <= leaderboard.MAX_UPSETS
    for flipbook in report.upsets:
        game = Ledger(registry).match(flipbook.match).games[flipbook.game]
        assert ratings[flipbook.better] < ratings[flipbook.other]
        assert flipbook.score in game.scores
        assert flipbook.length == len(game.opening) + len(game.actions)


def test_the_report_is_a_json_document_without_nan(report: LeagueReport) -> None:
    document = json.loads(json.dumps(report.to_json(), allow_nan=False))
    assert document["verdicts"][0]["curve"] == list(report.verdicts[0].curve)


def test_further_evidence_of_a_verdict_is_included(tmp_path: Path) -> None:
    with reported_league.empty(tmp_path) as registry:
        tictactoe.publish(registry, tictactoe.graph())
        league = registry.leagues.get(LEAGUE)
        verdict = open_verdict(registry, league, 1, "script:random", alpha=0.001)
        (reported,) = league_report(registry, LEAGUE).verdicts
        assert (reported.outcome, reported.reason[:16], reported.alpha) == (
            "open",
            "Undecided: after",
            pytest.approx(0.001),
        )
        registry.verdicts.void(verdict.id, "somebody stopped it")
        (reported,) = league_report(registry, LEAGUE).verdicts
        assert (reported.outcome, reported.reason) == ("void", "Void: somebody stopped it.")
        assert (reported.anchors, reported.confirmation) == ((), None)
        assert (reported.curve, reported.score, reported.elo) == ((), None, None)


def test_anchors_and_confirmations_are_included(tmp_path: Path) -> None:
    with reported_league.empty(tmp_path) as registry:
        for graph in (tictactoe.graph(wins=True), tictactoe.graph(wins=True, blocks=True)):
            tictactoe.publish(registry, graph)
        registry.aliases.set(LEAGUE, "champion", 1, expected=None, actor="me", reason="first")
        gate = {"anchors": ["script:random"], "margin": 100}
        nightly(tictactoe.config(gate=gate), registry=registry)
        newest = league_report(registry, LEAGUE).verdicts[0]
    assert newest.promoted
    assert [(anchor.ref, anchor.outcome) for anchor in newest.anchors] == [("script:random", "not worse")]
    assert newest.confirmation is not None
    assert newest.confirmation.games == 40


def test_an_empty_league_has_a_report(tmp_path: Path) -> None:
    with reported_league.empty(tmp_path) as registry:
        report = league_report(registry, LEAGUE)
    assert (report.games, report.champion, report.payoff, report.leaderboard) == (0, None, None, ())
    with reported_league.empty(tmp_path) as registry, pytest.raises(UnknownLeague):
        league_report(registry, "chess")


def test_different_sides_are_rated_separately(tmp_path: Path) -> None:
    with reported_league.league_with_roles(tmp_path) as registry:
        report = league_report(registry, LEAGUE, pictures=False)
    assert report.scoring == "side"
    assert set(report.by_side) == {"adversary", "good"}
    for own in report.by_side.values():
        assert {standing.games for standing in own} == {10}


def test_omissions_are_reported(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    for named in (module, leaderboard):
        monkeypatch.setattr(named, "MOST_CONTESTANTS", 3)
    monkeypatch.setattr(module, "MOST_VERDICTS", 1)
    report = league_report(registry, LEAGUE, pictures=False)
    assert report.payoff is not None
    assert report.payoff.contestants == tuple(standing.ref for standing in report.leaderboard[:3])
    assert [verdict.candidate for verdict in report.verdicts] == ["tictactoe@3"]
    assert report.left_out == (
        "The payoff matrix contains the best 3 of 5 contestants.",
        "Only the newest 1 of 3 verdicts are shown.",
    )


def test_games_of_another_environment_are_ignored(tmp_path: Path) -> None:
    with reported_league.league_with_roles(tmp_path) as other:
        original = league_report(other, LEAGUE, pictures=False)
        document = other.leagues.get(LEAGUE).config.model_dump(mode="json", by_alias=True)
        document["environment"]["kwargs"] = {"max_cycles": 9}
        changed = LeagueConfig.from_mapping(document)
        other.leagues.register(changed, interface(changed))
        after = league_report(other, LEAGUE, pictures=False)
    assert (original.games, after.games, after.leaderboard) == (20, 0, ())
