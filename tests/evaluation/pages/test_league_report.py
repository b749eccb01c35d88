import json
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import pytest

from evaluation import played
from evaluation.gate import distinct_games
from evaluation.nightly import nightly
from evaluation.pages import league_report as module
from evaluation.pages.league_report import LeagueReport, league_report
from evaluation.payoff import tabulate
from evaluation.standings import standings
from evaluation.verdicts import open_verdict
from league.config import LeagueConfig
from league.environments.building import interface
from league.errors import UnknownLeague
from league.registry.registry import Registry
from league.results.ledger import Ledger
from tests.evaluation import examples
from tests.evaluation.examples import LEAGUE
from tests.evaluation.pages import leagues

NOON = datetime(2026, 3, 3, 12, tzinfo=UTC)


@pytest.fixture(scope="module")
def registry(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Registry]:
    with leagues.of_a_night(tmp_path_factory.mktemp("home")) as opened:
        yield opened


@pytest.fixture(scope="module")
def report(registry: Registry) -> LeagueReport:
    return league_report(registry, LEAGUE, pictures=False, now=NOON)


def test_the_head_says_what_was_played(registry: Registry, report: LeagueReport) -> None:
    matches = Ledger(registry).matches(league=LEAGUE)
    assert (report.league, report.champion, report.made_at) == (LEAGUE, "tictactoe@3", "2026-03-03T12:00:00Z")
    assert report.games == sum(len(match.games) for match in matches)
    assert report.distinct_games == distinct_games(matches) < report.games


def test_the_standings_are_the_league_s_with_distinct_games(registry: Registry, report: LeagueReport) -> None:
    matches = Ledger(registry).matches(league=LEAGUE)
    for told, known in zip(report.standings, standings(registry, LEAGUE), strict=True):
        assert (told.ref, told.rating, told.interval, told.games) == (
            known.ref,
            known.rating,
            known.interval,
            known.games,
        )
        assert told.distinct_games == distinct_games(matches, told.ref)
    assert report.by_side == {}


def test_the_payoff_table_is_that_of_all_matches(registry: Registry, report: LeagueReport) -> None:
    refs = [standing.ref for standing in report.standings]
    assert report.payoff == tabulate(refs, report.sides, Ledger(registry).matches(league=LEAGUE))
    assert {share.ref for share in report.shares} == set(refs), "a round robin leaves no hole"
    assert sum(share.nash for share in report.shares) == pytest.approx(1)


def test_versions_carry_their_ratings_and_when_they_became_champion(report: LeagueReport) -> None:
    assert [version.number for version in report.versions] == [1, 2, 3]
    ratings = {standing.ref: standing.rating for standing in report.standings}
    assert [version.rating for version in report.versions] == [ratings[version.ref] for version in report.versions]
    assert [len(version.champion_at) for version in report.versions] == [1, 1, 2], "a rollback makes one again"


def test_verdicts_are_told_newest_first_with_a_curve_that_ends_where_the_record_does(
    registry: Registry, report: LeagueReport
) -> None:
    rows = registry.verdicts(LEAGUE)
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
    assert stronger.reason.startswith("It is the stronger one")
    assert weaker.reason.startswith("It is not the stronger one")


def test_promotions_say_how_who_and_why(report: LeagueReport) -> None:
    assert [(event.kind, event.champion, event.before) for event in report.promotions] == [
        ("rollback", "tictactoe@3", "tictactoe@1"),
        ("by hand", "tictactoe@1", "tictactoe@3"),
        ("promotion", "tictactoe@3", "tictactoe@2"),
        ("promotion", "tictactoe@2", None),
    ]
    assert report.promotions[1].reason == leagues.HOSTILE
    assert report.promotions[2].verdict == report.verdicts[0].verdict


def test_surprises_are_games_of_the_ledger_in_which_the_weaker_did_better(
    registry: Registry, report: LeagueReport
) -> None:
    ratings = {standing.ref: standing.rating or 0.0 for standing in report.standings}
    assert 0 < len(report.surprises) <= module.MOST_SURPRISES
    for book in report.surprises:
        game = Ledger(registry).match(book.match).games[book.game]
        assert ratings[book.better] < ratings[book.other]
        assert book.score in game.scores
        assert book.length == len(game.opening) + len(game.actions)


def test_it_is_a_json_document_without_nan(report: LeagueReport) -> None:
    document = json.loads(json.dumps(report.to_json(), allow_nan=False))
    assert document["verdicts"][0]["curve"] == list(report.verdicts[0].curve)


def test_a_verdict_s_further_evidence_is_passed_on(tmp_path: Path) -> None:
    with leagues.empty(tmp_path) as registry:
        examples.publish(registry, examples.graph())
        league = registry.league(LEAGUE)
        verdict = open_verdict(registry, league, 1, "script:random", alpha=0.001)
        (told,) = league_report(registry, LEAGUE).verdicts
        assert (told.outcome, told.reason[:25], told.alpha) == ("open", "It is not decided yet: af", 0.001)
        registry.void_verdict(verdict.id, "somebody stopped it")
        (told,) = league_report(registry, LEAGUE).verdicts
        assert (told.outcome, told.reason) == ("void", "somebody stopped it")
        assert (told.anchors, told.confirmation) == ((), None)
        assert (told.curve, told.score, told.elo) == ((), None, None)


def test_anchors_and_confirmations_are_told(tmp_path: Path) -> None:
    with leagues.empty(tmp_path) as registry:
        for graph in (examples.graph(wins=True), examples.graph(wins=True, blocks=True)):
            examples.publish(registry, graph)
        registry.set_alias(LEAGUE, "champion", 1, expected=None, actor="me", reason="first")
        gate = {"anchors": ["script:random"], "margin": 100}
        nightly(examples.config(gate=gate), registry=registry)
        newest = league_report(registry, LEAGUE).verdicts[0]
    assert newest.promoted
    assert [(anchor.ref, anchor.outcome) for anchor in newest.anchors] == [("script:random", "not inferior")]
    assert newest.confirmation is not None
    assert newest.confirmation.games == 40


def test_an_empty_league_has_a_report(tmp_path: Path) -> None:
    with leagues.empty(tmp_path) as registry:
        report = league_report(registry, LEAGUE)
    assert (report.games, report.champion, report.payoff, report.standings) == (0, None, None, ())
    with leagues.empty(tmp_path) as registry, pytest.raises(UnknownLeague):
        league_report(registry, "chess")


def test_unlike_sides_are_rated_one_by_one(tmp_path: Path) -> None:
    with leagues.of_unlike_sides(tmp_path) as registry:
        report = league_report(registry, LEAGUE, pictures=False)
    assert report.scoring == "side"
    assert set(report.by_side) == {"adversary", "good"}
    for own in report.by_side.values():
        assert {standing.games for standing in own} == {10}


def test_what_is_left_out_is_said(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    for named in (module, played):
        monkeypatch.setattr(named, "MOST_CONTESTANTS", 3)
    monkeypatch.setattr(module, "MOST_VERDICTS", 1)
    report = league_report(registry, LEAGUE, pictures=False)
    assert report.payoff is not None
    assert report.payoff.contestants == tuple(standing.ref for standing in report.standings[:3])
    assert [verdict.candidate for verdict in report.verdicts] == ["tictactoe@3"]
    assert report.left_out == (
        "The payoff table has the best 3 of 5 contestants.",
        "Of 3 verdicts the newest 1 are told.",
    )


def test_games_of_another_environment_do_not_count(tmp_path: Path) -> None:
    with leagues.of_unlike_sides(tmp_path) as other:
        before = league_report(other, LEAGUE, pictures=False)
        document = other.league(LEAGUE).config.model_dump(mode="json", by_alias=True)
        document["environment"]["kwargs"] = {"max_cycles": 9}
        changed = LeagueConfig.from_mapping(document)
        other.register(changed, interface(changed))
        after = league_report(other, LEAGUE, pictures=False)
    assert (before.games, after.games, after.standings) == (20, 0, ())
