"""Anchors: how they are resolved, and that a candidate inferior to one is not promoted."""

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from scipy.stats import binomtest
from sqlalchemy import delete

from benchmarks.simulations.exploiter_gates import against_anchor
from evaluation.gating.criteria.anchor import resolve_anchors
from evaluation.gating.evidence import VerdictReport
from evaluation.gating.former_champions import earlier_champions
from evaluation.gating.nightly import nightly
from evaluation.gating.verification import verify
from evaluation.matches.tournament import evaluate
from league.config.gate import GateConfig
from league.config.league import LeagueConfig
from league.errors import ConfigError, UnknownPolicy, VerdictRefuted
from league.policies.loading import check_anchors
from league.registry.registry import Registry
from league.registry.storage import tables
from league.results.ledger import Ledger
from tests.support.leagues import tictactoe
from tests.support.leagues.judged_league import MIDDLING, STRONG, STRONGEST, WEAK, league_of

BOT = "script:policy_league.examples.tictactoe_bot:act"


@pytest.fixture
def registry(tmp_path: Path) -> Iterator[Registry]:
    opened = league_of(tmp_path / "home", WEAK, MIDDLING, STRONG, STRONGEST)
    yield opened
    opened.close()


def config(**gate: Any) -> LeagueConfig:
    return tictactoe.config(play={"opening_plies": 2, "num_envs": 32}, gate=gate)


def promote(registry: Registry, *versions: int) -> None:
    for version in versions:
        now = registry.aliases.current(tictactoe.LEAGUE).get("champion")
        registry.aliases.set(tictactoe.LEAGUE, "champion", version, expected=now, actor="me", reason="test")


def refs(registry: Registry, league: LeagueConfig, candidate: int, champion: str) -> list[str]:
    registry.leagues.register(league, registry.leagues.get(tictactoe.LEAGUE).interface)
    return [
        anchor.ref
        for anchor in resolve_anchors(
            registry, registry.leagues.get(tictactoe.LEAGUE), f"tictactoe@{candidate}", champion
        )
    ]


def test_configured_anchors_precede_earlier_champions(registry: Registry) -> None:
    promote(registry, 1, 2, 3)
    league = config(anchors=["script:random"], earlier_champions=2)
    assert refs(registry, league, 4, "tictactoe@3") == ["script:random", "tictactoe@2", "tictactoe@1"]
    assert refs(registry, config(earlier_champions=1), 4, "tictactoe@3") == ["tictactoe@2"]
    assert refs(registry, config(earlier_champions=0), 4, "tictactoe@3") == []


def test_a_candidate_is_not_its_own_anchor_and_aliases_are_pinned(registry: Registry) -> None:
    promote(registry, 1, 2)
    registry.aliases.set(tictactoe.LEAGUE, "gold", 3, expected=None, actor="me", reason="test")
    league = config(anchors=["@gold", "@silver", "@4", "tictactoe@2", "@champion"], earlier_champions=9)
    assert refs(registry, league, 4, "tictactoe@2") == ["tictactoe@3", "tictactoe@1"]


def test_a_rolled_back_champion_is_not_an_anchor(registry: Registry) -> None:
    promote(registry, 1, 2, 3)
    registry.aliases.rollback(tictactoe.LEAGUE, actor="me", reason="broken")
    assert earlier_champions(registry, registry.leagues.get(tictactoe.LEAGUE), 2) == ["tictactoe@1"]


def test_a_former_champion_of_another_environment_is_not_an_anchor(registry: Registry) -> None:
    promote(registry, 1, 2)
    changed = registry.leagues.get(tictactoe.LEAGUE)
    other = dataclasses.replace(changed, environment_digest="0" * 64)
    assert earlier_champions(registry, changed, 2) == ["tictactoe@1"]
    assert earlier_champions(registry, other, 2) == []


def test_an_unknown_anchor_is_reported_and_no_candidate_is_tested(registry: Registry) -> None:
    with pytest.raises(UnknownPolicy, match="stockfish"):
        refs(registry, config(anchors=["script:stockfish"]), 4, "tictactoe@1")
    with pytest.raises(ConfigError, match=r"gate\.anchors: league tictactoe has no version 77; the newest is 4"):
        nightly(config(anchors=["@77"]), registry=registry)


@pytest.mark.parametrize(
    ("ref", "message"),
    [
        ("@silver", "league tictactoe has no alias 'silver'; known: none yet"),
        ("other@1", "other@1 is not a version of league tictactoe"),
    ],
)
def test_anchors_are_checked_before_anything_is_played(registry: Registry, ref: str, message: str) -> None:
    invalid = config(anchors=[ref])
    for play in (
        lambda: nightly(invalid, registry=registry),
        lambda: evaluate(tictactoe.LEAGUE, registry=registry, blocks=1),
    ):
        registry.leagues.register(invalid, registry.leagues.get(tictactoe.LEAGUE).interface)
        with pytest.raises(ConfigError, match=rf"gate\.anchors: {message}"):
            play()
    assert Ledger(registry).schedules(tictactoe.LEAGUE) == []


def test_a_version_of_another_environment_is_no_anchor(registry: Registry) -> None:
    changed = tictactoe.config(
        environment={"entry_point": "pettingzoo.classic.connect_four_v3"}, gate={"anchors": ["@1"]}
    )
    with pytest.raises(ConfigError, match=r"gate\.anchors: tictactoe@1 was trained in another environment"):
        check_anchors(changed, registry)


def test_the_alias_of_the_champion_may_be_an_anchor_before_there_is_one(registry: Registry) -> None:
    check_anchors(config(anchors=["@champion"]), registry)


def test_a_candidate_that_beats_the_champion_but_not_an_anchor_is_not_promoted(tmp_path: Path) -> None:
    """Version 3 beats the champion but loses to the script that wins and blocks."""
    registry = league_of(tmp_path / "trap", WEAK, MIDDLING, STRONG)
    promote(registry, 1, 2)
    league = config(anchors=[{"ref": "script:one_ply", "mode": "at_least"}], earlier_champions=0, elo1=60, margin=30)
    report = nightly(league, registry=registry)
    rejected = {verdict.candidate: verdict for verdict in report.verdicts}["tictactoe@3"]
    assert (rejected.outcome, rejected.promoted) == ("reject", False)
    assert rejected.note == "it beat the champion, but is weaker than script:one_ply"
    assert rejected.llr >= rejected.bounds[1]
    (anchor,) = rejected.anchors
    assert (anchor.outcome, anchor.margin) == ("inferior", 30)
    assert anchor.llr <= anchor.bounds[0]
    assert sum(anchor.counts) == anchor.blocks
    assert registry.aliases.current(tictactoe.LEAGUE)["champion"] == 2
    assert verify(rejected.verdict, registry=registry, replays=4).matches > rejected.blocks
    with registry.database.write() as session:
        session.execute(delete(tables.MatchTable).filter_by(schedule=anchor.schedule, position=0))
    with pytest.raises(VerdictRefuted, match="lacks match 0 of"):
        verify(rejected.verdict, registry=registry)


def test_a_candidate_that_passes_all_anchors_is_promoted_with_a_reason(registry: Registry) -> None:
    promote(registry, 1, 2)
    league = config(anchors=["script:random"], earlier_champions=1, margin=60)
    nightly(league, registry=registry)
    event = next(event for event in registry.aliases.history(tictactoe.LEAGUE) if event.version == 3)
    assert (
        "and is at most 0.1 worse than the champion against script:random, and is at most 60 weaker than tictactoe@1"
        in event.reason
    )
    row = registry.verdicts.get(str(event.verdict))
    assert row.evidence is not None
    assert [anchor["outcome"] for anchor in row.evidence["anchors"]] == ["not worse", "not inferior"]
    assert verify(row.id, registry=registry).outcome == "promote"


@pytest.mark.parametrize(
    ("gate", "message"),
    [
        ({"anchors": [{"ref": "script:random", "margin": 300}]}, "margins must lie within ±190"),
        ({"anchors": [{"ref": "script:random", "margins": 3}]}, "did you mean 'margin'"),
        ({"anchors": [{"ref": BOT, "mode": "no_worse", "margin": 50}]}, r"anchors\[0\]\.margin must be smaller than 1"),
        ({"anchors": [{"ref": BOT, "mode": "best"}]}, "should be 'no_worse' or 'at_least', got 'best'"),
        ({"margin": 0}, "gate.margin"),
        ({"model": "returns"}, "return_bound"),
        ({"model": "returns", "return_bound": 2}, "margin, which is a return with model: returns, must be smaller"),
        ({"model": "returns", "return_bound": 200, "return0": 3, "return1": 2}, "return0 first"),
        ({"nights": 0}, "gate.nights"),
    ],
)
def test_an_invalid_gate_is_rejected(gate: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        config(**gate)


def test_a_candidate_that_loses_to_a_bot_is_refused_and_the_bot_is_rated(tmp_path: Path) -> None:
    registry = league_of(tmp_path / "home", STRONG)
    report = nightly(config(anchors=[{"ref": BOT, "margin": 40}]), registry=registry)
    assert [verdict.outcome for verdict in report.verdicts] == ["reject"]
    assert BOT in str(registry.verdicts.all(tictactoe.LEAGUE)[0].evidence)
    assert report.champion is None
    ratings = {standing.ref: standing.rating for standing in report.leaderboard}
    assert ratings[BOT] is not None
    assert ratings[BOT] > ratings["tictactoe@1"]
    verify(report.verdicts[0].verdict, registry=registry)
    registry.close()


def test_an_anchor_that_cannot_be_imported_ends_the_run_before_it_starts(registry: Registry) -> None:
    with pytest.raises(ConfigError, match=r"gate.anchors: script:no_bots:act: cannot import 'no_bots'"):
        nightly(config(anchors=["script:no_bots:act"]), registry=registry)
    assert registry.verdicts.all(tictactoe.LEAGUE) == []


def test_a_malformed_anchor_is_rejected_with_the_configuration() -> None:
    with pytest.raises(ConfigError, match=r"gate.anchors.*my_package.module:name"):
        config(anchors=["script:bots:"])


def test_without_a_champion_the_note_names_the_script_that_was_beaten(tmp_path: Path) -> None:
    registry = league_of(tmp_path / "first", STRONG)
    league = config(anchors=[{"ref": "script:one_ply", "mode": "at_least"}], earlier_champions=0, elo1=60, margin=30)
    report = nightly(league, registry=registry)
    (rejected,) = report.verdicts
    assert rejected.note == "it beat script:random, but is weaker than script:one_ply"
    assert report.champion is None
    assert verify(rejected.verdict, registry=registry).outcome == "reject"


def decided_against_bot(home: Path, league: LeagueConfig) -> tuple[Registry, VerdictReport]:
    """The verdict on a candidate that beats the champion; the bot is stronger than both."""
    registry = league_of(home, MIDDLING, STRONG)
    promote(registry, 1)
    report = nightly(league, registry=registry)
    return registry, report.verdicts[0]


@pytest.mark.parametrize(("mode", "outcome"), [(None, "promote"), ("no_worse", "promote"), ("at_least", "reject")])
def test_a_bot_that_is_stronger_than_all_versions_blocks_no_progress(
    tmp_path: Path, mode: str | None, outcome: str
) -> None:
    """The candidate does better against it than the champion, but loses to it."""
    league = config(anchors=[{"ref": BOT, "mode": mode}], earlier_champions=0)
    registry, verdict = decided_against_bot(tmp_path, league)
    assert verdict.outcome == outcome, verdict
    (anchor,) = verdict.anchors
    assert anchor.score is not None
    assert anchor.score < 0.5, "the bot is stronger"
    if outcome == "promote":
        assert anchor.champion_score is not None
        assert anchor.difference is not None
        assert (anchor.mode, anchor.outcome, anchor.margin, anchor.elo) == ("no_worse", "not worse", 0.1, None)
        assert anchor.champion_score < anchor.score - 0.1
        assert anchor.difference.mean == pytest.approx(anchor.score - anchor.champion_score)
        assert (
            f"is at most 0.1 worse than the champion against {BOT}"
            in registry.aliases.history(tictactoe.LEAGUE)[0].reason
        )
    assert verify(verdict.verdict, registry=registry, replays=4).outcome == outcome
    registry.close()


def test_a_candidate_that_does_worse_against_a_bot_than_the_champion_is_refused(tmp_path: Path) -> None:
    """The hypotheses of the first test are so low that a weaker candidate passes it."""
    registry = league_of(tmp_path, STRONG, MIDDLING)
    promote(registry, 1)
    anchors = [{"ref": BOT, "mode": "no_worse", "margin": 0.05}]
    league = config(anchors=anchors, earlier_champions=0, model="logistic", elo0=-2000, elo1=-1500)
    (verdict,) = nightly(league, registry=registry).verdicts
    assert (verdict.outcome, verdict.anchors[0].outcome) == ("reject", "worse")
    assert verdict.note == f"it is not inferior to the champion, but does worse than the champion against {BOT}"
    verify(verdict.verdict, registry=registry)
    registry.close()


def test_without_a_champion_a_candidate_is_compared_with_the_script_that_it_plays(tmp_path: Path) -> None:
    registry = league_of(tmp_path, STRONG)
    (verdict,) = nightly(config(anchors=[BOT, "script:random"]), registry=registry).verdicts
    assert [(anchor.ref, anchor.outcome) for anchor in verdict.anchors] == [(BOT, "not worse")]
    assert set(Ledger(registry).schedule(verdict.anchors[0].schedule).contestants) == {
        "tictactoe@1",
        "script:random",
        BOT,
    }
    assert verdict.promoted
    verify(verdict.verdict, registry=registry)
    registry.close()


def test_candidate_and_champion_play_an_anchor_from_common_seeds(tmp_path: Path) -> None:
    registry, verdict = decided_against_bot(tmp_path, config(anchors=[BOT], earlier_champions=0))
    schedule = Ledger(registry).schedule(verdict.anchors[0].schedule)
    assert [schedule.contestants_at(position) for position in range(2)] == [("tictactoe@2", BOT), ("tictactoe@1", BOT)]
    seeds = schedule.seeds_at(range(20))
    assert seeds[::2] == seeds[1::2]
    registry.close()


@pytest.mark.parametrize(
    ("anchor", "expected"),
    [
        ("script:one_ply", ("no_worse", 0.1)),
        (BOT, ("no_worse", 0.1)),
        ("https://models.example.org/v2/models/solver", ("no_worse", 0.1)),
        ("@gold", ("at_least", 50)),
        ("tictactoe@3", ("at_least", 50)),
        ({"ref": BOT, "margin": 40}, ("at_least", 40)),
        ({"ref": BOT, "mode": "at_least"}, ("at_least", 50)),
        ({"ref": BOT, "mode": "no_worse", "margin": 0.02}, ("no_worse", 0.02)),
        ({"ref": "@3", "mode": "no_worse"}, ("no_worse", 0.1)),
    ],
)
def test_the_default_mode_depends_on_the_anchor(anchor: Any, expected: tuple[str, float]) -> None:
    gate = config(anchors=[anchor]).gate
    assert (gate.anchors[0].tested_mode, gate.margin_of(gate.anchors[0])) == expected


def test_a_margin_of_no_worse_is_in_returns_if_the_gate_tests_them() -> None:
    gate = config(anchors=[BOT], model="returns", return_bound=4, margin=0.5).gate
    assert gate.margin_of(gate.anchors[0]) == 0.5


def test_a_comparison_against_an_anchor_keeps_its_error_rates() -> None:
    """The anchor is stronger than all versions. `benchmarks.calibration` measures more cases."""
    settings = GateConfig(alpha=0.05, nights=None).compared_with_champion(0.1)
    worse, equal = (against_anchor(settings, 0.22, gap, 0.0, gates=300, seed=1) for gap in (-0.1, 0.0))
    assert binomtest(int(worse.promoted.sum()), 300).proportion_ci(0.99).low <= 0.05
    assert binomtest(int(equal.promoted.sum()), 300).proportion_ci(0.99).high >= 0.95
