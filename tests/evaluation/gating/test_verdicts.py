"""Verdicts: tests against champion, anchors and exploiters, on games that are played."""

import dataclasses
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sqlalchemy import delete

from evaluation.documents import Progress
from evaluation.gating.criteria.anchor import resolve_anchors
from evaluation.gating.criteria.exploitability import exploitability
from evaluation.gating.criteria.exploiter import recent_exploiters
from evaluation.gating.evidence import VerdictReport
from evaluation.gating.former_champions import earlier_champions
from evaluation.gating.nightly import nightly
from evaluation.gating.verdicts import conclude, open_verdict
from evaluation.gating.verification import verify
from evaluation.matches.leaderboard import CountedGames, compute_leaderboard
from evaluation.matches.tournament import evaluate
from evaluation.schedules.builders import paired_test, verdict
from league.config.league import LeagueConfig
from league.config.play import PlayConfig
from league.errors import ConfigError, InvalidInput, UnknownPolicy, VerdictRefuted
from league.policies.loading import check_contestants
from league.refs import CheckpointRef
from league.registry.registry import Registry
from league.registry.storage import tables
from league.results.ledger import Ledger
from tests.support.crashes import ProcessDeath
from tests.support.leagues import tictactoe
from tests.support.leagues.judged_league import (
    MIDDLING,
    STRONG,
    STRONGEST,
    WEAK,
    config,
    league_of,
    promote,
    reconfigure,
)
from tests.support.leagues.tictactoe import LEAGUE
from tests.support.templates import copied

BOT = "script:policy_league.examples.tictactoe_bot:act"


QUICK = {"elo1": 150, "max_blocks": 200, "earlier_champions": 0, "confirmation_blocks": 0}
ANY_CANDIDATE = {"model": "logistic", "elo0": -2000, "elo1": -1500}
"""Hypotheses so low that a weaker candidate passes the test against the champion."""


def verdict_on(registry: Registry, candidate: int, champion: int = 1, **options: Any) -> VerdictReport:
    row = open_verdict(registry, registry.leagues.get(LEAGUE), candidate, f"{LEAGUE}@{champion}", **options)
    return conclude(registry, row)


@pytest.fixture
def registry(tmp_path: Path) -> Iterator[Registry]:
    with closing(league_of(tmp_path / "home", WEAK, MIDDLING, STRONG, STRONGEST)) as opened:
        yield opened


def refs(registry: Registry, candidate: int, champion: str, **gate: object) -> list[str]:
    """The anchors of a candidate with these settings."""
    reconfigure(registry, config(**gate))
    row = registry.leagues.get(LEAGUE)
    return [anchor.ref for anchor in resolve_anchors(registry, row, f"tictactoe@{candidate}", champion)]


def test_configured_anchors_precede_earlier_champions(registry: Registry) -> None:
    """A candidate is not its own anchor, nor is the champion; aliases are pinned, and missing ones left out."""
    check_contestants(config(anchors=["@champion"]), None, registry)
    promote(registry, 1, 2)
    registry.aliases.set(LEAGUE, "gold", 3, expected=None, actor="me", reason="test")
    aliases = ["@gold", "@silver", "@4", "tictactoe@2", "@champion"]
    assert refs(registry, 4, "tictactoe@2", anchors=aliases, earlier_champions=9) == ["tictactoe@3", "tictactoe@1"]
    promote(registry, 3)
    assert refs(registry, 4, "tictactoe@3", anchors=["script:random"], earlier_champions=2) == [
        "script:random",
        "tictactoe@2",
        "tictactoe@1",
    ]
    assert refs(registry, 4, "tictactoe@3", earlier_champions=1) == ["tictactoe@2"]
    assert refs(registry, 4, "tictactoe@3", earlier_champions=0) == []
    registry.aliases.rollback(LEAGUE, actor="me", reason="broken")
    row = registry.leagues.get(LEAGUE)
    assert earlier_champions(registry, row, 2) == ["tictactoe@1"], "version 3 was rolled back"
    assert earlier_champions(registry, dataclasses.replace(row, environment_digest="0" * 64), 2) == []


def test_anchors_are_checked_before_anything_is_played(registry: Registry, subtests: pytest.Subtests) -> None:
    with pytest.raises(UnknownPolicy, match="stockfish"):
        refs(registry, 4, "tictactoe@1", anchors=["script:stockfish"])
    for ref, message in (
        ("@77", "league tictactoe has no version 77; the newest is 4"),
        ("@silver", "league tictactoe has no alias 'silver'; known: none yet"),
        ("other@1", "other@1 is not a version of league tictactoe"),
    ):
        invalid = config(anchors=[ref])
        for play in (
            lambda invalid=invalid: nightly(invalid, registry=registry),
            lambda: evaluate(LEAGUE, registry=registry, blocks=1),
        ):
            reconfigure(registry, invalid)
            with subtests.test(ref=ref), pytest.raises(ConfigError, match=rf"gate\.anchors: {message}"):
                play()
    with pytest.raises(ConfigError, match=r"gate\.anchors: script:no_bots:act: cannot import 'no_bots'"):
        nightly(config(anchors=["script:no_bots:act"]), registry=registry)
    environment = {"entry_point": "pettingzoo.classic.connect_four_v3"}
    with pytest.raises(ConfigError, match=r"gate\.anchors: tictactoe@1 was trained in another environment"):
        check_contestants(tictactoe.config(environment=environment, gate={"anchors": ["@1"]}), None, registry)
    assert (Ledger(registry).schedules(LEAGUE), registry.verdicts.all(LEAGUE)) == ([], [])


def test_a_candidate_that_beats_the_champion_but_not_an_anchor_is_not_promoted(registry: Registry) -> None:
    """Version 3 beats the champion but loses to the script that wins and blocks."""
    anchors = [{"ref": "script:one_ply", "mode": "at_least"}]
    reconfigure(registry, config(anchors=anchors, earlier_champions=0, elo1=60, margin=30))
    rejected = verdict_on(promote(registry, 1, 2), 3, 2)
    assert (rejected.outcome, rejected.promoted) == ("reject", False)
    assert rejected.note == "it beat the champion, but is weaker than script:one_ply"
    assert rejected.llr >= rejected.bounds[1]
    (anchor,) = rejected.anchors
    assert (anchor.outcome, anchor.margin) == ("inferior", 30)
    assert anchor.llr <= anchor.bounds[0]
    assert sum(anchor.counts) == anchor.blocks
    assert registry.aliases.current(LEAGUE)["champion"] == 2
    assert verify(rejected.verdict, registry=registry, replays=4).matches > rejected.blocks
    with registry.database.write() as session:
        session.execute(delete(tables.MatchTable).filter_by(schedule=anchor.schedule, position=0))
    with pytest.raises(VerdictRefuted, match="lacks match 0 of"):
        verify(rejected.verdict, registry=registry)


def test_a_candidate_that_passes_all_anchors_is_promoted_with_a_reason(registry: Registry) -> None:
    reconfigure(registry, config(anchors=["script:random"], earlier_champions=1, margin=60))
    report = verdict_on(promote(registry, 1, 2), 3, 2)
    reason = (
        "and is at most 0.1 worse than the champion against script:random, and is at most 60 weaker than tictactoe@1"
    )
    assert reason in registry.aliases.history(LEAGUE)[0].reason
    assert [anchor.outcome for anchor in report.anchors] == ["not worse", "not inferior"]
    assert verify(report.verdict, registry=registry).outcome == "promote"


def test_without_a_champion_a_candidate_that_loses_to_a_bot_is_refused_and_the_bot_is_rated(tmp_path: Path) -> None:
    with closing(league_of(tmp_path, STRONG)) as registry:
        report = nightly(config(anchors=[{"ref": BOT, "margin": 40}]), registry=registry)
        (verdict,) = report.verdicts
        assert (verdict.outcome, report.champion) == ("reject", None)
        assert verdict.note == f"it beat script:random, but is weaker than {BOT}"
        ratings = {standing.ref: standing.rating for standing in report.leaderboard}
        assert ratings[BOT] > ratings["tictactoe@1"]
        verify(verdict.verdict, registry=registry)


@pytest.mark.parametrize(("mode", "outcome"), [(None, "promote"), ("at_least", "reject")])
def test_a_bot_that_is_stronger_than_all_blocks_no_progress(tmp_path: Path, mode: str | None, outcome: str) -> None:
    """The candidate does better against it than the champion, but loses to it. Both play from the same seeds."""
    league = config(anchors=[{"ref": BOT, "mode": mode}], earlier_champions=0)
    with closing(promote(league_of(tmp_path, MIDDLING, STRONG, config=league), 1)) as registry:
        verdict = verdict_on(registry, 2)
        assert verdict.outcome == outcome, verdict
        (anchor,) = verdict.anchors
        assert anchor.score < 0.5, "the bot is stronger"
        assert verify(verdict.verdict, registry=registry, replays=4).outcome == outcome
        if outcome == "promote":
            assert (anchor.mode, anchor.outcome, anchor.margin, anchor.elo) == ("no_worse", "not worse", 0.1, None)
            assert anchor.champion_score < anchor.score - 0.1
            assert anchor.difference.mean == pytest.approx(anchor.score - anchor.champion_score)
            reason = f"is at most 0.1 worse than the champion against {BOT}"
            assert reason in registry.aliases.history(LEAGUE)[0].reason
            schedule = Ledger(registry).schedule(anchor.schedule)
            assert [schedule.contestants_at(p) for p in range(2)] == [("tictactoe@2", BOT), ("tictactoe@1", BOT)]
            seeds = schedule.seeds_at(range(20))
            assert seeds[::2] == seeds[1::2]


def test_without_a_champion_a_candidate_is_compared_with_the_script_that_it_plays(tmp_path: Path) -> None:
    with closing(league_of(tmp_path, STRONG)) as registry:
        (verdict,) = nightly(config(anchors=[BOT, "script:random"]), registry=registry).verdicts
        assert [(anchor.ref, anchor.outcome) for anchor in verdict.anchors] == [(BOT, "not worse")]
        contestants = Ledger(registry).schedule(verdict.anchors[0].schedule).contestants
        assert set(contestants) == {"tictactoe@1", "script:random", BOT}
        assert verdict.promoted
        verify(verdict.verdict, registry=registry)


@pytest.fixture
def exploited(tmp_path: Path) -> Iterator[Registry]:
    """Versions 1 and 2 were champions; 3 and 4 are exploiters of 1, 5 of 2; 6 is a candidate."""
    with closing(league_of(tmp_path / "exploited", WEAK, MIDDLING, config=config(**QUICK))) as opened:
        for target in ("tictactoe@1", "tictactoe@1", "tictactoe@2", None):
            tictactoe.publish(opened, STRONG, exploits=target)
        yield promote(opened, 1, 2)


def with_exploiter(
    home: Path,
    champion: bytes,
    candidate: bytes,
    exploiter: bytes = STRONG,
    league: LeagueConfig | None = None,
    **gate: object,
) -> Registry:
    """A champion, its exploiter and a candidate, the versions 1 to 3."""
    registry = league_of(home, champion, config=league or config(**QUICK | gate))
    tictactoe.publish(registry, exploiter, exploits="tictactoe@1")
    tictactoe.publish(registry, candidate)
    return promote(registry, 1)


def test_the_newest_exploiter_of_each_recent_champion_takes_part(exploited: Registry) -> None:
    for number, opponent, expected in (
        (2, "tictactoe@2", ["tictactoe@5", "tictactoe@4"]),
        (1, "tictactoe@2", ["tictactoe@5"]),
        (0, "tictactoe@2", []),
        (2, "script:random", []),
    ):
        reconfigure(exploited, config(**QUICK, exploited_champions=number))
        row = exploited.leagues.get(LEAGUE)
        assert [exploiter.ref for exploiter in recent_exploiters(exploited, row, opponent)] == expected


def test_pairs_have_common_seeds_and_seats(exploited: Registry) -> None:
    league = exploited.leagues.get(LEAGUE)
    test = verdict(league.config, league.interface, "tictactoe@6", "tictactoe@2")
    schedule = paired_test(league.config, league.interface, "exploiter", test, [("tictactoe@5", "tictactoe@5")], 10)
    assert [schedule.contestants_at(position)[0] for position in range(4)] == ["tictactoe@6", "tictactoe@2"] * 2
    seeds = schedule.seeds_at(range(20))
    assert seeds == [schedule.seed_at(position) for position in range(20)]
    assert seeds[::2] == seeds[1::2]
    assert len(set(seeds)) == 10


def test_a_candidate_that_does_as_well_is_promoted_and_its_verdict_is_verified(exploited: Registry) -> None:
    report = verdict_on(exploited, 6, 2)
    assert report.promoted, report
    assert [(test.ref, test.exploits, test.outcome) for test in report.exploiters] == [
        ("tictactoe@5", "tictactoe@2", "not worse"),
        ("tictactoe@4", "tictactoe@1", "not worse"),
    ]
    first = report.exploiters[0]
    assert first.difference.mean == pytest.approx(first.score - first.champion_score)
    assert first.games == 4 * first.blocks == 4 * sum(first.counts)
    reason = ", and is at most 0.1 worse than the champion against tictactoe@5, an exploiter of tictactoe@2, and is"
    assert reason in exploited.aliases.history(LEAGUE)[0].reason
    assert verify(report.verdict, registry=exploited, replays=30).replayed == 30


def test_a_candidate_that_does_worse_is_rejected(tmp_path: Path) -> None:
    registry = with_exploiter(tmp_path, STRONG, MIDDLING, **ANY_CANDIDATE, exploiter_margin=0.02)
    report = verdict_on(registry, 3, alpha=0.4)
    assert (report.outcome, report.promoted, report.exploiters[0].outcome) == ("reject", False, "worse"), report
    assert report.note == (
        "it is not inferior to the champion,"
        " but does worse than the champion against tictactoe@2, an exploiter of tictactoe@1"
    )
    verify(report.verdict, registry=registry, replays=4)


def test_returns_are_compared_if_the_gate_tests_them(tmp_path: Path) -> None:
    """A pair of blocks is half the difference of two differences of returns. The margin is in returns."""
    registry = with_exploiter(tmp_path, MIDDLING, STRONG, model="returns", return_bound=2, margin=0.5)
    report = verdict_on(registry, 3)
    (test,) = report.exploiters
    assert (test.outcome, test.margin) == ("not worse", 0.5), report
    matches = Ledger(registry).matches(league=LEAGUE, schedule=test.schedule)[: 2 * test.blocks]
    gains = [match.mean_return(0) - match.mean_return(1) for match in matches]
    gaps = [candidate - champion for candidate, champion in zip(gains[::2], gains[1::2], strict=True)]
    assert any(gaps)
    assert test.difference.mean == pytest.approx(np.mean(gaps))
    verify(report.verdict, registry=registry)


def test_scores_on_the_same_side_are_compared_once_per_block(tmp_path: Path) -> None:
    play = PlayConfig(scoring="side", opening_plies=2, num_envs=32)
    by_side = config(**QUICK | {"elo1": 60}).model_copy(update={"play": play})
    registry = with_exploiter(tmp_path, MIDDLING, STRONG, league=by_side)
    report = verdict_on(registry, 3)
    assert len(report.counts) == 5, "two comparisons, of the two sides"
    (test,) = report.exploiters
    assert (test.outcome, len(test.counts), sum(test.counts)) == ("not worse", 9, test.blocks), report
    verify(report.verdict, registry=registry)


def test_forfeits_of_the_exploiter_are_wins_of_both(tmp_path: Path) -> None:
    registry = with_exploiter(tmp_path, MIDDLING, STRONG, exploiter=tictactoe.graph(faulty=True))
    report = verdict_on(registry, 3)
    assert report.promoted, report
    matches = Ledger(registry).matches(league=LEAGUE, schedule=report.exploiters[0].schedule)
    assert any(game.forfeits for match in matches for game in match.games)


@pytest.mark.parametrize("model", ["logistic", "returns"])
def test_forfeits_of_the_candidate_are_losses_where_they_are_allowed(tmp_path: Path, model: str) -> None:
    """A forfeit counts as the largest difference of returns."""
    easy = ANY_CANDIDATE | {"model": model, "return0": -1.9, "return1": -1.8, "return_bound": 2, "margin": 0.1}
    faulty = tictactoe.graph(wins=True, blocks=True, faulty=True)
    registry = with_exploiter(tmp_path, STRONG, faulty, forfeits=True, exploiter_margin=0.05, **easy)
    report = verdict_on(registry, 3, alpha=0.4)
    (test,) = report.exploiters
    assert (report.outcome, test.outcome) == ("reject", "worse"), report
    assert test.difference.mean < 0
    verify(report.verdict, registry=registry)


def test_a_test_that_died_continues_with_the_next_match(exploited: Registry, tmp_path: Path) -> None:
    row = open_verdict(exploited, exploited.leagues.get(LEAGUE), 6, "tictactoe@2")
    exploited.close()
    with copied(exploited.storage.home, tmp_path / "other") as other:
        expected = conclude(other, row)

    def die(event: Progress | VerdictReport) -> None:
        if isinstance(event, Progress) and event.what.endswith("against tictactoe@5") and event.played:
            raise ProcessDeath

    with pytest.raises(ProcessDeath):
        conclude(exploited, row, listener=die)
    schedule = row.tests[0]["schedule"]
    before = Ledger(exploited).matches(league=LEAGUE, schedule=schedule)
    assert before
    assert exploited.verdicts.get(row.id).outcome is None
    assert verdict_on(exploited, 6, 2) == expected
    assert Ledger(exploited).matches(league=LEAGUE, schedule=schedule)[: len(before)] == before


def test_an_exploiter_that_no_longer_loads_is_a_fault_and_its_games_do_not_affect_ratings(exploited: Registry) -> None:
    (file,) = exploited.artifacts.path(LEAGUE, 5).glob("*.onnx")
    file.chmod(0o644)
    graph = file.read_bytes()
    file.write_bytes(graph[:100])
    report = nightly(config(**QUICK), registry=exploited)
    assert report.champion == "tictactoe@2"
    (fault,) = [fault for fault in report.faults if fault.startswith("tictactoe@6 against tictactoe@2")]
    assert "tictactoe/5/shared.onnx was changed" in fault
    assert [row.outcome for row in exploited.verdicts.all(LEAGUE) if row.candidate == 6] == [None]
    file.write_bytes(graph)
    assert nightly(config(**QUICK), registry=exploited).champion == "tictactoe@6"
    table = {standing.ref: standing for standing in compute_leaderboard(exploited, LEAGUE)}
    assert table["tictactoe@5"].rating is None
    assert table["tictactoe@5"].games > 0
    assert "tictactoe@5" in CountedGames(exploited, exploited.leagues.get(LEAGUE)).payoff().contestants
    ledger = Ledger(exploited)
    ledger.purge([schedule.id for schedule in ledger.schedules(LEAGUE) if schedule.kind == "exploiter"])
    without = {standing.ref: standing.rating for standing in compute_leaderboard(exploited, LEAGUE)}
    assert without == {ref: table[ref].rating for ref in without}


BRIEF = {"elo0": 0, "elo1": 100, "max_blocks": 20, "nights": None, "confirmation_blocks": 0}
SAMPLED = tictactoe.config(play={"opening_plies": 2, "num_envs": 32, "actions": "sampled"}, gate=BRIEF)
ANOTHER_KIND = "the league plays with sampled actions now, but the test was with greedy ones"


def test_after_a_change_of_actions_an_open_verdict_becomes_void_and_ratings_start_anew(tmp_path: Path) -> None:
    with closing(league_of(tmp_path, STRONG, config=config(**BRIEF))) as registry:
        row = registry.leagues.get(LEAGUE)
        first = conclude(registry, open_verdict(registry, row, 1, "script:random"))
        assert verify(first.verdict, registry=registry).is_current
        tictactoe.publish(registry, WEAK)
        opened = open_verdict(registry, row, 2, "tictactoe@1" if first.promoted else "script:random")
        assert compute_leaderboard(registry, LEAGUE)
        reconfigure(registry, SAMPLED)
        assert not verify(first.verdict, registry=registry).is_current
        row = registry.leagues.get(LEAGUE)
        report = conclude(registry, opened)
        assert (report.outcome, report.note) == ("void", ANOTHER_KIND)
        assert compute_leaderboard(registry, LEAGUE) == ()
        assert CountedGames(registry, row).games == 0
        again = open_verdict(registry, row, 2, opened.champion)
        assert Ledger(registry).schedule(again.schedule).actions == "sampled"
        assert conclude(registry, again).outcome in ("promote", "reject", "inconclusive")
        assert verify(again.id, registry=registry, replays=4).replayed == 4
        assert compute_leaderboard(registry, LEAGUE)


def test_games_before_a_change_of_actions_promote_nobody(tmp_path: Path) -> None:
    events: list[object] = []

    def change(event: object) -> None:
        if not events:
            reconfigure(registry, SAMPLED)
        events.append(event)

    with closing(league_of(tmp_path, STRONG, config=config(**BRIEF))) as registry:
        opened = open_verdict(registry, registry.leagues.get(LEAGUE), 1, "script:random")
        report = conclude(registry, opened, listener=change)
        assert events
        assert (report.outcome, report.note) == ("void", ANOTHER_KIND)
        assert registry.aliases.current(LEAGUE) == {}


def test_the_bound_of_exploitability_is_that_of_the_best_exploiter(tmp_path: Path) -> None:
    """Version 1 neither wins nor blocks; versions 2 and 3 are its exploiters, and version 3 is as weak as it."""
    with closing(league_of(tmp_path, WEAK)) as registry:
        for graph in (STRONG, WEAK):
            tictactoe.publish(registry, graph, exploits="tictactoe@1")
        report = exploitability(CheckpointRef(LEAGUE, 1), registry=registry, blocks=20)
        assert (report.ref, [score.ref for score in report.exploiters]) == (
            "tictactoe@1",
            ["tictactoe@2", "tictactoe@3"],
        )
        strong, weak = report.exploiters
        assert strong.games == weak.games == 40
        assert report.bound == pytest.approx(strong.low)
        assert 0.5 < strong.low < strong.score <= strong.high
        assert weak.low < 0.5 < weak.high
        assert strong.gain.mean > 0
        named = exploitability(CheckpointRef(LEAGUE, 2), ["@3", "script:random"], registry=registry, blocks=10)
        assert {score.ref for score in named.exploiters} == {"tictactoe@3", "script:random"}
        assert named.bound < 0.5
        for refs, message in (
            ((), r"^tictactoe@2 has no exploiters: train one with .*--against tictactoe@2"),
            (["@2"], "tictactoe@2 cannot be its own exploiter"),
        ):
            with pytest.raises(InvalidInput, match=message):
                exploitability(CheckpointRef(LEAGUE, 2), refs, registry=registry)
