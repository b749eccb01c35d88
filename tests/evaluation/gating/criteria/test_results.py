"""What the tests of a verdict show, in numbers and in words."""

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from evaluation.gating.criteria.anchor import AnchorReport, AnchorTest
from evaluation.gating.criteria.champion import ChampionTest
from evaluation.gating.criteria.criterion import Contest, Criterion
from evaluation.gating.criteria.exploitability import ExploitabilityReport, ExploitabilityTest
from evaluation.gating.criteria.exploiter import ExploiterTest
from evaluation.gating.gate_result import CriterionResult
from evaluation.gating.verdicts import open_verdict
from league.config.gate import GateConfig
from league.registry.registry import Registry
from league.registry.storage.rows import VerdictRow
from league.results.records import Game, Match
from tests.support.leagues.judged_league import CONFIG, STRONG, WEAK, league_of

CANDIDATE, CHAMPION, BOT = "l@3", "l@2", "script:bots.solver:act"
GATE = GateConfig(model="logistic", elo1=40, nights=None)
RETURNS = GateConfig(model="returns", return_bound=4, return1=1, margin=0.5, nights=None)
NORMALIZED = GATE.model_copy(update={"model": "normalized"})
FIRST = ChampionTest(schedule="s")
ANCHOR = AnchorTest(ref=BOT, margin=0.1, schedule="s", mode="no_worse")
EXPLOITER = ExploiterTest(ref="l@7", exploits="l@1", margin=0.1, schedule="s")
WON, LOST, EVEN = (1.0, 1.0), (0.0, 0.0), (1.0, 0.0)


def verdict(gate: GateConfig = GATE) -> VerdictRow:
    settings = {"gate": gate.model_dump(mode="json")}
    return VerdictRow(
        id="l-verdict-1",
        league="l",
        candidate=3,
        champion=CHAMPION,
        settings=settings,
        outcome=None,
        evidence=None,
        opened_at=datetime.now(UTC),
        closed_at=None,
    )


def match(contestant: str, opponent: str, scores: Sequence[float]) -> Match:
    """A block with the contestant's scores in both games, and returns of -1 to 1."""
    games = tuple(
        Game((i, 1 - i), 1, (), (), (2 * score - 1, 1 - 2 * score), (score, 1 - score))
        for i, score in enumerate(scores)
    )
    return Match("s/0", "l", "s", 0, (contestant, opponent), 1, "digest", games)


def against(opponent: str, *blocks: Sequence[float], number: int = 200) -> list[Match]:
    return [match(CANDIDATE, opponent, scores) for _ in range(number) for scores in blocks]


def rounds(candidate: Sequence[float], champion: Sequence[float], number: int = 200, pairs: int = 1) -> list[Match]:
    """Blocks of candidate and champion in turn, each against its own opponents."""
    return [
        match(contestant, f"{contestant}-exploiter-{pair}", scores)
        for _ in range(number)
        for pair in range(pairs)
        for contestant, scores in ((CANDIDATE, candidate), (CHAMPION, champion))
    ]


def result_of(test: Criterion, matches: list[Match], gate: GateConfig = GATE) -> CriterionResult:
    """These kinds read neither the registry nor the ledger."""
    nothing: Any = None
    contest = Contest(nothing, nothing, verdict(gate), nothing, gate, CANDIDATE, CHAMPION, "the champion")
    return test.result(contest, matches)


def test_the_test_against_the_champion_names_both_scores() -> None:
    result = result_of(FIRST, against(CHAMPION, WON))
    assert (result.decision.outcome, result.passed) == ("promote", "beat the champion")
    assert result.scores == "It scored 100.0 % against l@2, which scored 0.0 %."
    assert len(result.decision.counted) == result.decision.blocks < 200


def test_a_candidate_that_is_not_stronger_is_told_the_score_that_it_needs() -> None:
    result = result_of(FIRST, against(CHAMPION, LOST, EVEN))
    assert result.decision.outcome == "reject"
    assert "To pass, it must score more than about 52.9 % against l@2" in result.requirement
    assert result.requirement.endswith("(gate.elo0: 0, gate.elo1: 40).")
    assert result.wider == "gate.elo0 and gate.elo1 that are further apart"


def test_the_score_that_is_needed_depends_on_the_deviation_with_normalized_elo() -> None:
    needed = []
    for blocks in ((WON, EVEN, EVEN, LOST), (EVEN, EVEN, EVEN, EVEN, (1.0, 0.5), (0.5, 0.0))):
        requirement = result_of(FIRST, against(CHAMPION, *blocks, number=4), NORMALIZED).requirement
        needed.append(float(requirement.split("about ")[1].split(" %")[0]))
    assert needed[0] > needed[1] > 50


def test_with_returns_the_bar_is_a_difference_of_returns() -> None:
    assert "exceed those of l@2 by more than about 0.5" in result_of(FIRST, [], RETURNS).requirement
    assert "at most about 0.05 in returns worse" in result_of(ANCHOR, rounds(LOST, EVEN), RETURNS).requirement
    test = ExploitabilityTest(margin=0.5, schedule="s", of_candidate=("a",), of_champion=("b",), blocks=300)
    report = result_of(test, rounds(LOST, WON), RETURNS).report
    assert report is not None
    assert report.finding.startswith("more exploitable than l@2 by 0.5 in returns after ")


@pytest.mark.parametrize(
    ("test", "opponent", "setting"),
    [(ANCHOR, BOT, "margin of the anchor: 0.1"), (EXPLOITER, "l@7, an exploiter of l@1", "gate.exploiter_margin: 0.1")],
)
def test_a_paired_test_compares_with_the_champion(test: Criterion, opponent: str, setting: str) -> None:
    ref = opponent.partition(",")[0]
    result = result_of(test, rounds(LOST, EVEN))
    assert result.decision.outcome == "reject"
    assert result.failed == f"does worse than the champion against {opponent}"
    assert result.scores == f"Against {ref} it scored 0.0 %, and l@2 50.0 %."
    assert result.requirement == f"To pass, it must score more than about 45.0 % against {ref} ({setting})."
    assert result.wider == f"a larger {setting}"
    report: Any = result.report
    assert (report.score, report.champion_score, report.difference.mean) == (0.0, 0.5, -0.5)
    expected = f"against {ref} worse than l@2 by 0.1 of all points after {report.games} games"
    assert (report.outcome, report.finding) == ("worse", expected)
    better = result_of(test, rounds(WON, EVEN))
    assert better.passed == f"is at most 0.1 worse than the champion against {opponent}"
    assert better.report is not None
    assert better.report.outcome == "not worse"


def test_an_undecided_test_names_no_margin() -> None:
    report = result_of(EXPLOITER, rounds(EVEN, EVEN, number=1)).report
    assert report is not None
    assert (report.outcome, report.finding) == ("open", "against l@7 open compared with l@2 after 4 games")


@pytest.mark.parametrize(
    ("improvement", "candidate", "outcome", "margin"),
    [
        (0.0, WON, "not more exploitable", " by 0.1 of all points"),
        (0.0, LOST, "more exploitable", " by 0.1 of all points"),
        (0.2, WON, "less exploitable", ""),
        (0.2, LOST, "not less exploitable", " by 0.2 of all points"),
    ],
)
def test_a_comparison_of_exploitability(
    improvement: float, candidate: Sequence[float], outcome: str, margin: str
) -> None:
    """That a candidate is less exploitable shows a difference of any size."""
    refs = {ref: tuple(f"{ref}-exploiter-{pair}" for pair in range(2)) for ref in (CANDIDATE, CHAMPION)}
    test = ExploitabilityTest(
        margin=0.1,
        improvement=improvement,
        schedule="s",
        of_candidate=refs[CANDIDATE],
        of_champion=refs[CHAMPION],
        blocks=150,
    )
    result = result_of(test, rounds(candidate, EVEN, pairs=2))
    report = result.report
    assert isinstance(report, ExploitabilityReport)
    assert report.outcome == outcome
    expected = f"{outcome} than l@2{margin} after {report.games} games: a best response scores at least "
    assert report.finding.startswith(expected)
    assert result.scores == f"Against its exploiters it scored {100 * candidate[0]:.1f} %, and l@2 50.0 %."
    limit = (
        "must achieve at least about 0.1 of all points less"
        if improvement
        else "may achieve at most about 0.05 of all points more"
    )
    assert result.requirement.startswith(f"To pass, exploiters {limit} against it than against l@2 (gate.exploiter")
    assert report.candidate is not None
    assert {score.games for score in report.candidate.exploiters} == {300}
    assert report.difference is not None
    assert report.difference.mean == pytest.approx(0.5 - candidate[0])


def test_exploitability_is_estimated_from_a_fixed_number_of_rounds_only() -> None:
    test = ExploitabilityTest(margin=0.1, schedule="s", of_candidate=("a",), of_champion=("b",), blocks=201)
    result = result_of(test, rounds(LOST, WON))
    report = result.report
    assert isinstance(report, ExploitabilityReport)
    assert (report.candidate, report.difference, result.scores) == (None, None, None)
    assert report.finding.endswith("games")


@pytest.fixture
def registry(tmp_path: Path) -> Registry:
    return league_of(tmp_path, WEAK, STRONG, config=CONFIG)


@pytest.mark.parametrize("ref", ["script:one_ply", "tictactoe@1"])
def test_an_anchor_names_what_the_champion_scored_in_other_games(registry: Registry, ref: str) -> None:
    row = open_verdict(registry, registry.leagues.get("tictactoe"), 2, "script:random")
    test = AnchorTest(ref=ref, margin=50.0, schedule="s", mode="at_least")
    result = test.result(Contest.of(registry, row), [match("tictactoe@2", ref, LOST)] * 300)
    assert isinstance(result.report, AnchorReport)
    assert (result.failed, result.report.outcome) == (f"is weaker than {ref}", "inferior")
    assert result.report.finding == f"inferior to {ref} by 50 Elo after {result.decision.games} games"
    assert result.scores == (
        f"Against {ref} it scored 0.0 % in {result.decision.games} games; script:random has not played it."
    )
    hint = " With mode: no_worse, it need only do as well as the champion there."
    assert result.requirement.endswith("(margin of the anchor: 50)." + hint * (ref == "script:one_ply"))


@pytest.mark.parametrize(
    "test",
    [
        ANCHOR,
        EXPLOITER,
        ExploitabilityTest(margin=0.1, schedule=None, blocks=20, improvement=0.1),
        ExploitabilityTest(margin=0.1, schedule="s", of_candidate=("l@4",), of_champion=("l@5",), blocks=20),
    ],
)
def test_a_recorded_test_is_read_as_it_was_written(test: Criterion) -> None:
    record = test.to_record()
    assert record["kind"] == test.kind
    assert type(test).of_record(record) == test
