import json
import math
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from filelock import FileLock
from sqlalchemy.orm import Session

from evaluation import tournament, verdicts
from evaluation.nightly import nightly
from evaluation.pages.league_report import league_report
from evaluation.report import NightReport, Progress, VerdictReport
from evaluation.verification import verify
from league.config import LeagueConfig
from league.environments.building import interface
from league.errors import AlreadyRunning, ConfigError
from league.histograms import BOUNDS
from league.registry.database import Database
from league.registry.registry import Registry
from league.registry.rows import Shadowing
from league.results.ledger import Ledger
from league.settings import Storage
from tests.evaluation import examples

CONFIG = examples.config(play={"opening_plies": 2, "copies": 2})
WEAK = examples.graph()
MIDDLING = examples.graph(wins=True)
STRONG = examples.graph(wins=True, blocks=True)
STRONGEST = examples.graph(wins=True, blocks=True, order=examples.CENTRE_FIRST)


def league_of(home: Path, *graphs: bytes, config: LeagueConfig = CONFIG) -> Registry:
    registry = examples.registry(home, play=config.play.model_dump(), gate=config.gate.model_dump())
    for graph in graphs:
        examples.publish(registry, graph)
    return registry


@pytest.fixture
def registry(tmp_path: Path) -> Iterator[Registry]:
    opened = league_of(tmp_path / "home", WEAK, MIDDLING, STRONG, MIDDLING)
    yield opened
    opened.close()


def state(registry: Registry) -> dict[str, Any]:
    """All that a night leaves behind, its clock times apart."""
    return {
        "matches": Ledger(registry).matches(league=examples.LEAGUE),
        "verdicts": [(v.id, v.outcome, v.evidence) for v in registry.verdicts(examples.LEAGUE)],
        "champions": [(e.version, e.previous, e.verdict) for e in registry.history(examples.LEAGUE)],
        "nights": [(n.candidates, n.alpha, n.ended_at is None) for n in registry.nights(examples.LEAGUE)],
    }


def outcomes(report: NightReport) -> list[tuple[str, str, str, bool]]:
    return [(v.candidate, v.opponent, v.outcome, v.promoted) for v in report.verdicts]


def test_a_night_finds_the_strongest_and_promotes_it(registry: Registry) -> None:
    told: list[Progress | VerdictReport] = []
    report = nightly(CONFIG, registry=registry, listener=told.append)
    assert outcomes(report) == [
        ("tictactoe@1", "script:random", "reject", False),
        ("tictactoe@2", "script:random", "promote", True),
        ("tictactoe@3", "tictactoe@2", "promote", True),
        ("tictactoe@4", "tictactoe@3", "reject", False),
    ]
    assert (report.champion_before, report.champion, report.faults) == (None, "tictactoe@3", ())
    assert registry.aliases(examples.LEAGUE) == {"champion": 3}
    assert [standing.ref for standing in report.standings][:2] == ["script:one_ply", "tictactoe@3"]
    assert all(standing.rating is not None for standing in report.standings)
    assert [each for each in told if isinstance(each, VerdictReport)] == list(report.verdicts)
    assert any(isinstance(each, Progress) and each.llr for each in told)
    assert json.loads(json.dumps(report.to_json(), allow_nan=False))["champion"] == "tictactoe@3"


def test_promotions_say_who_why_and_on_which_verdict(registry: Registry) -> None:
    report = nightly(CONFIG, registry=registry)
    event = registry.history(examples.LEAGUE)[0]
    assert event.verdict == report.verdicts[2].verdict
    assert event.actor == "league nightly"
    assert "beat tictactoe@2" in event.reason


def test_verdicts_hold_their_evidence(registry: Registry) -> None:
    nightly(CONFIG, registry=registry)
    for row in registry.verdicts(examples.LEAGUE):
        assert row.evidence is not None
        assert sum(row.evidence["counts"]) == row.evidence["blocks"] == row.evidence["games"] / 2
        lower, upper = row.evidence["bounds"]
        assert (row.evidence["llr"] >= upper) == (row.outcome == "promote")
        assert (row.evidence["llr"] <= lower) == (row.outcome == "reject")
        assert 0 < row.evidence["distinct_games"] <= row.evidence["games"]


def test_the_next_night_has_nothing_to_do(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    nightly(CONFIG, registry=registry)
    before = state(registry)
    monkeypatch.setattr(tournament, "player", None)
    report = nightly(CONFIG, registry=registry)
    assert report.verdicts == ()
    assert (report.champion_before, report.champion) == ("tictactoe@3", "tictactoe@3")
    assert state(registry) == before


def test_a_new_version_is_judged_against_the_champion_of_the_moment(registry: Registry) -> None:
    nightly(CONFIG, registry=registry)
    examples.publish(registry, STRONGEST)
    registry.set_alias(examples.LEAGUE, "champion", 2, expected=3, actor="me", reason="by hand")
    report = nightly(CONFIG, registry=registry)
    assert outcomes(report) == [("tictactoe@5", "tictactoe@2", "promote", True)]


def test_an_even_match_leaves_the_champion(tmp_path: Path) -> None:
    config = examples.config(gate={"elo0": -20, "elo1": 20, "max_blocks": 30})
    registry = league_of(tmp_path, STRONG, STRONG, config=config)
    registry.set_alias(examples.LEAGUE, "champion", 1, expected=None, actor="me", reason="first")
    report = nightly(config, registry=registry)
    assert outcomes(report) == [("tictactoe@2", "tictactoe@1", "inconclusive", False)]
    assert report.champion == "tictactoe@1"


def test_one_policy_under_two_numbers_is_not_promoted(tmp_path: Path) -> None:
    """Both games of a block are then one game with the seats swapped: it scores a half exactly, and is rejected."""
    registry = league_of(tmp_path, STRONG, STRONG)
    registry.set_alias(examples.LEAGUE, "champion", 1, expected=None, actor="me", reason="first")
    report = nightly(CONFIG, registry=registry)
    assert outcomes(report) == [("tictactoe@2", "tictactoe@1", "reject", False)]
    assert report.verdicts[0].score == 0.5
    assert report.verdicts[0].distinct_games <= report.verdicts[0].games / 2


@pytest.mark.usefixtures("ray_session")
def test_the_number_of_workers_changes_nothing(tmp_path: Path) -> None:
    alone, many = (league_of(tmp_path / name, WEAK, MIDDLING, STRONG) for name in ("alone", "many"))
    nightly(CONFIG, registry=alone)
    nightly(CONFIG, registry=many, workers=2)
    assert state(alone) == state(many)


class Crash(BaseException):
    """The process is gone."""


@contextmanager
def crashing_after(writes: int, monkeypatch: pytest.MonkeyPatch) -> Iterator[list[int]]:
    """The process dies right after its `writes`-th transaction; yields a counter of the transactions."""
    original, count = Database.write, [0]

    @contextmanager
    def write(database: Database) -> Iterator[Session]:
        with original(database) as session:
            yield session
        count[0] += 1
        if count[0] == writes:
            raise Crash

    with monkeypatch.context() as patch:
        patch.setattr(Database, "write", write)
        yield count


def test_a_night_that_died_after_any_of_its_writes_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """After each single transaction in turn: what stands in the end is what an undisturbed night leaves."""
    monkeypatch.setattr("evaluation.nightly.RATING_BLOCKS", 6)
    gate = {"elo1": 150, "max_blocks": 100, "nights": 2, "alpha": 0.2, "anchors": ["script:random"], "margin": 150}
    config = examples.config(gate=gate, play={"opening_plies": 2, "copies": 4})
    league_of(tmp_path / "fresh", MIDDLING, STRONG, config=config).close()
    quiet = _copy(tmp_path / "fresh", tmp_path / "quiet")
    with crashing_after(0, monkeypatch) as count:
        nightly(config, registry=quiet)
    expected, writes = state(quiet), count[0]
    assert writes > 15
    assert [version for version, _, _ in expected["champions"]] == [2, 1]
    for crash_at in range(1, writes + 1):
        registry = _copy(tmp_path / "fresh", tmp_path / str(crash_at))
        with crashing_after(crash_at, monkeypatch), pytest.raises(Crash):
            nightly(config, registry=registry)
        report = nightly(config, registry=registry)
        assert state(registry) == expected, f"after transaction {crash_at}"
        assert report.champion == "tictactoe@2"
        registry.close()


def _copy(home: Path, to: Path) -> Registry:
    shutil.copytree(home, to)
    return Registry.open(Storage.at(to))


KILLED = """
import os, signal, sys
from league.registry.registry import Registry
from league.settings import Storage
from evaluation.nightly import nightly
from evaluation.report import VerdictReport
from tests.evaluation.test_nightly import CONFIG

verdicts = 0
def listener(told):
    global verdicts
    verdicts += isinstance(told, VerdictReport)
    if verdicts == 2 and not isinstance(told, VerdictReport) and told.played:
        os.kill(os.getpid(), signal.SIGKILL)
nightly(CONFIG, registry=Registry.open(Storage.at(sys.argv[1])), listener=listener)
"""


def test_a_night_that_was_killed_goes_on(registry: Registry, tmp_path: Path) -> None:
    command = [sys.executable, "-c", KILLED, str(registry.storage.home)]
    killed = subprocess.run(command, cwd=Path(__file__).parents[2], timeout=120, check=False)
    assert killed.returncode == -signal.SIGKILL
    assert [verdict.outcome for verdict in registry.verdicts(examples.LEAGUE)] == ["reject", "promote", None]
    report = nightly(CONFIG, registry=registry)
    assert [verdict.candidate for verdict in report.verdicts] == ["tictactoe@3", "tictactoe@4"]
    quiet = league_of(tmp_path / "quiet", WEAK, MIDDLING, STRONG, MIDDLING)
    nightly(CONFIG, registry=quiet)
    assert state(registry) == state(quiet)


def test_a_second_night_is_told_so(registry: Registry) -> None:
    home = registry.storage.home
    (home / "locks").mkdir(exist_ok=True)
    with FileLock(home / "locks" / "nightly-tictactoe.lock"), pytest.raises(AlreadyRunning, match="tictactoe"):
        nightly(CONFIG, registry=registry)
    assert nightly(CONFIG, registry=registry).champion == "tictactoe@3"


def test_a_champion_moved_during_the_test_is_not_overruled(registry: Registry) -> None:
    """The candidate has won against version 2, but a person has put version 1 in its place."""

    def interfere(told: Progress | VerdictReport) -> None:
        if isinstance(told, Progress) and told.what == "tictactoe@3 against tictactoe@2" and not told.played:
            registry.set_alias(examples.LEAGUE, "champion", 1, expected=2, actor="me", reason="by hand")

    report = nightly(CONFIG, registry=registry, listener=interfere)
    refused = report.verdicts[2]
    assert (refused.outcome, refused.promoted) == ("promote", False)
    assert refused.note is not None
    assert "tictactoe@1 now" in refused.note
    assert registry.history(examples.LEAGUE)[0].version == 4, "version 4 beat version 1 later in that night"
    again = nightly(CONFIG, registry=registry)
    assert outcomes(again) == [("tictactoe@3", "tictactoe@4", "promote", True)]


def test_an_open_verdict_against_a_champion_of_the_past_is_void(registry: Registry) -> None:
    row = registry.league(examples.LEAGUE)
    registry.set_alias(examples.LEAGUE, "champion", 2, expected=None, actor="me", reason="first")
    verdict = verdicts.open_verdict(registry, row, 3, "tictactoe@2")
    registry.set_alias(examples.LEAGUE, "champion", 4, expected=2, actor="me", reason="by hand")
    report = nightly(CONFIG, registry=registry)
    assert outcomes(report)[0] == ("tictactoe@3", "tictactoe@2", "void", False)
    assert ("tictactoe@3", "tictactoe@4", "promote", True) in outcomes(report)
    assert registry.verdicts(examples.LEAGUE)[0].id == verdict.id


def test_a_void_verdict_is_followed_by_other_games(registry: Registry) -> None:
    row = registry.league(examples.LEAGUE)
    first = verdicts.open_verdict(registry, row, 3, "script:random")
    registry.close_verdict(first.id, "void", {})
    second = verdicts.open_verdict(registry, row, 3, "script:random")
    assert second.id != first.id
    assert second.id == verdicts.open_verdict(registry, row, 3, "script:random").id


def test_a_promotion_that_was_rolled_back_is_not_repeated(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    """The process dies between promotion and closing its verdict, and a person rolls back before the next night."""
    with monkeypatch.context() as patch:
        patch.setattr(Registry, "close_verdict", _crash_on_promotion(Registry.close_verdict))
        with pytest.raises(Crash):
            nightly(CONFIG, registry=registry)
    assert registry.aliases(examples.LEAGUE) == {"champion": 3}
    registry.rollback(examples.LEAGUE, actor="me", reason="no")
    report = nightly(CONFIG, registry=registry)
    assert outcomes(report)[0] == ("tictactoe@3", "tictactoe@2", "promote", True)
    assert registry.aliases(examples.LEAGUE) == {"champion": 2}
    assert [e.kind for e in registry.history(examples.LEAGUE)] == ["rollback", "set", "set"]


def _crash_on_promotion(close: Any) -> Any:
    def crash(registry: Registry, verdict: str, outcome: str, evidence: dict[str, Any]) -> None:
        if outcome == "promote" and evidence["candidate"] == "tictactoe@3":
            raise Crash
        close(registry, verdict, outcome, evidence)

    return crash


def test_a_tampered_version_is_reported_and_the_others_judged(registry: Registry) -> None:
    (registry.artifacts.root / "tictactoe" / "3" / "shared.onnx").write_bytes(STRONGEST)
    report = nightly(CONFIG, registry=registry)
    assert report.champion == "tictactoe@2"
    assert [verdict.candidate for verdict in report.verdicts] == ["tictactoe@1", "tictactoe@2", "tictactoe@4"]
    assert any("tictactoe@3" in fault and "shared.onnx" in fault for fault in report.faults)


def test_an_empty_league_has_a_quiet_night(tmp_path: Path) -> None:
    report = nightly(CONFIG, registry=league_of(tmp_path))
    assert (report.verdicts, report.standings, report.champion) == ((), (), None)


def test_a_home_that_cannot_be_written_is_one_sentence(registry: Registry) -> None:
    locks = registry.storage.home / "locks"
    locks.write_text("in the way")
    with pytest.raises(Exception, match="cannot be locked") as error:
        nightly(CONFIG, registry=registry)
    assert "\n" not in str(error.value)


def test_hypotheses_out_of_reach_are_refused_by_name() -> None:
    with pytest.raises(ConfigError, match="elo1"):
        examples.config(gate={"elo1": 400})


def test_a_candidate_that_was_no_shadow_is_not_tested_where_its_gate_asks_for_that(tmp_path: Path) -> None:
    gate = {"shadow_agreement": 0.5, "latency_ms": 10, "shadow_observations": 10}
    config = examples.config(play={"opening_plies": 2, "copies": 2}, gate=gate)
    registry = league_of(tmp_path / "home", MIDDLING, STRONG, STRONGEST, config=config)
    registry.set_alias(examples.LEAGUE, "champion", 1, expected=None, actor="test", reason="test")
    latency = (0, 100, *[0] * (len(BOUNDS) - 1))
    shown = [Shadowing(examples.LEAGUE, 3, 1, 100, 100, 60, 0, 0, 0, latency, 4_000_000)]
    registry.report("replica-1", {}, shown)
    report = nightly(config, registry=registry)
    assert outcomes(report) == [
        ("tictactoe@2", "tictactoe@1", "void", False),
        ("tictactoe@3", "tictactoe@1", "promote", True),
    ]
    assert report.verdicts[0].games == 0
    assert "shown 0 observations as the champion's shadow" in str(report.verdicts[0].note)
    registry.close()


def test_where_there_is_no_champion_there_is_nothing_to_be_the_shadow_of(tmp_path: Path) -> None:
    config = examples.config(play={"opening_plies": 2, "copies": 2}, gate={"shadow_agreement": 1.0})
    registry = league_of(tmp_path / "home", STRONG, config=config)
    assert outcomes(nightly(config, registry=registry)) == [("tictactoe@1", "script:random", "promote", True)]
    registry.close()


def spending(**gate: Any) -> LeagueConfig:
    return examples.config(play={"opening_plies": 2, "copies": 4}, gate={"nights": 365, "max_blocks": 1000} | gate)


def test_a_night_shares_its_part_of_a_years_alpha_among_its_candidates(tmp_path: Path) -> None:
    config = spending()
    registry = league_of(tmp_path, MIDDLING, STRONG, config=config)
    report = nightly(config, registry=registry)
    assert [verdict.alpha for verdict in report.verdicts] == [pytest.approx(0.05 / 365 / 2)] * 2
    assert report.alpha_spent == pytest.approx(0.05 / 365)
    assert report.verdicts[0].bounds[1] == pytest.approx(math.log(0.95 / (0.05 / 730)))
    assert report.champion == "tictactoe@2"
    examples.publish(registry, STRONGEST)
    second = nightly(config, registry=registry)
    assert [verdict.alpha for verdict in second.verdicts] == [pytest.approx(0.05 / 365)]
    first_row, second_row = registry.nights(examples.LEAGUE)
    assert (first_row.candidates, second_row.candidates) == ((1, 2), (3,))
    assert second_row.report == second.to_json()


def test_when_a_years_alpha_is_spent_nobody_is_judged_and_the_report_says_what_to_set(tmp_path: Path) -> None:
    config = spending(nights=1)
    registry = league_of(tmp_path, MIDDLING, config=config)
    nightly(config, registry=registry)
    examples.publish(registry, STRONG)
    report = nightly(config, registry=registry)
    assert (report.verdicts, report.alpha_spent) == ((), pytest.approx(0.05))
    assert "have spent all of gate.alpha (0.05); where more than 1 nights a year are held" in report.faults[0]
    enough = spending(nights=1, alpha=0.1)
    assert nightly(enough, registry=registry).champion == "tictactoe@2"


def test_versions_that_come_during_a_night_wait_for_the_next_and_are_not_forgotten(tmp_path: Path) -> None:
    """A night is killed with one of its two candidates judged; a third comes before it is started again."""
    config = spending()
    registry = league_of(tmp_path, MIDDLING, STRONG, config=config)

    def die(told: Progress | VerdictReport) -> None:
        if isinstance(told, VerdictReport):
            raise Crash

    with pytest.raises(Crash):
        nightly(config, registry=registry, listener=die)
    examples.publish(registry, STRONGEST)
    report = nightly(config, registry=registry)
    part = 0.05 / 365
    assert [(v.candidate, v.alpha) for v in report.verdicts] == [
        ("tictactoe@2", pytest.approx(part / 2)),
        ("tictactoe@3", pytest.approx(part)),
    ]
    assert [row.candidates for row in registry.nights(examples.LEAGUE)] == [(1, 2), (3,)]
    assert all(row.ended_at for row in registry.nights(examples.LEAGUE))


def test_a_verdict_that_a_person_stops_is_void_and_its_alpha_is_spent(tmp_path: Path) -> None:
    config = spending(elo0=-20, elo1=20)
    registry = league_of(tmp_path, STRONG, STRONG, STRONG, config=config)
    registry.set_alias(examples.LEAGUE, "champion", 1, expected=None, actor="me", reason="first")

    def stop(told: Progress | VerdictReport) -> None:
        if isinstance(told, Progress) and told.what == "tictactoe@2 against tictactoe@1" and told.played:
            verdicts.void(registry, registry.verdicts(examples.LEAGUE)[0].id, actor="me", reason="looks bad")

    report = nightly(config, registry=registry, listener=stop)
    stopped, other = report.verdicts
    assert (stopped.outcome, stopped.note) == ("void", "voided by me: looks bad")
    assert 0 < stopped.blocks < 1000
    assert other.outcome != "void"
    assert report.alpha_spent == pytest.approx(stopped.alpha + other.alpha) == pytest.approx(0.05 / 365)
    again = nightly(config, registry=registry)
    assert [verdict.candidate for verdict in again.verdicts] == ["tictactoe@2"], "judged again, on other games"
    assert again.alpha_spent == pytest.approx(2 * 0.05 / 365)


def test_purged_games_count_for_nothing_and_stay(registry: Registry) -> None:
    first = nightly(CONFIG, registry=registry).verdicts[1]
    before = len(Ledger(registry).results(examples.LEAGUE))
    verdicts.void(registry, first.verdict, actor="me", reason="a broken machine", purge=True)
    row = registry.verdict(first.verdict)
    assert row.outcome == "void"
    own = [row.schedule, row.settings["confirmation"], *(anchor["schedule"] for anchor in row.settings["anchors"])]
    played = sum(len(Ledger(registry).positions(schedule)) for schedule in own)
    assert len(Ledger(registry).results(examples.LEAGUE)) == before - played
    assert len(Ledger(registry).matches(league=examples.LEAGUE, schedule=row.schedule)) >= first.blocks
    assert verify(first.verdict, registry=registry).outcome == "void"
    page = league_report(registry, examples.LEAGUE)
    assert page.games == sum(result.games for result in Ledger(registry).results(examples.LEAGUE))


def test_a_promotion_is_confirmed_by_fresh_games_of_fixed_length(registry: Registry) -> None:
    report = nightly(CONFIG, registry=registry)
    promoted = [verdict for verdict in report.verdicts if verdict.promoted]
    assert [gain.verdict for gain in report.confirmations] == [verdict.verdict for verdict in promoted]
    for gain, verdict in zip(report.confirmations, promoted, strict=True):
        low, high = gain.interval
        assert gain.games == 40
        assert low is not None
        assert high is not None
        assert low < gain.elo < high
        row = registry.verdict(verdict.verdict)
        fresh = Ledger(registry).matches(league=examples.LEAGUE, schedule=row.settings["confirmation"])
        counted = Ledger(registry).matches(league=examples.LEAGUE, schedule=row.schedule)
        assert {match.seed for match in fresh}.isdisjoint(match.seed for match in counted)
    assert nightly(CONFIG, registry=registry).confirmations == ()


def test_returns_are_tested_by_betting_where_the_gate_says_so(tmp_path: Path) -> None:
    """Where everybody plays alone, and how much better matters: returns of mpe2.simple are between -100 and 0 here."""
    gate = {"model": "returns", "return_bound": 100, "margin": 10, "nights": None, "confirmation_blocks": 10}
    environment = {"entry_point": "mpe2.simple_v3", "kwargs": {"max_cycles": 12}}
    config = LeagueConfig.from_mapping({"league": "kind", "environment": environment, "gate": gate})
    registry = Registry.open(Storage.at(tmp_path))
    registry.register(config, interface(config))
    spaces = registry.league("kind").interface.of_policy("shared")
    for graph in (examples.linear(spaces, 3), examples.chasing(spaces), examples.linear(spaces, 3)):
        examples.publish(registry, graph, "kind")
    registry.set_alias("kind", "champion", 1, expected=None, actor="me", reason="first")
    report = nightly(config, registry=registry, workers=0)
    assert report.faults == ()
    better, worse = report.verdicts
    assert (better.outcome, better.bounds) == ("promote", pytest.approx((-math.log(20), math.log(20))))
    assert better.difference is not None
    assert better.difference.mean > 0
    assert worse.outcome == "reject"
    assert report.confirmations[0].difference is not None
    for verdict in report.verdicts:
        verify(verdict.verdict, registry=registry, replays=3)


def test_a_bound_that_returns_exceed_is_named_and_the_verdict_can_be_voided(tmp_path: Path) -> None:
    gate = {"model": "returns", "return_bound": 0.5, "margin": 0.2}
    config = examples.config(gate=gate)
    registry = league_of(tmp_path, STRONG, config=config)
    report = nightly(config, registry=registry)
    assert report.verdicts == ()
    assert "gate.return_bound is 0.5, but the returns of a block differ by" in report.faults[0]
    verdicts.void(registry, registry.verdicts(examples.LEAGUE)[0].id, actor="me", reason="bound")
    mended = examples.config(gate=gate | {"return_bound": 2})
    assert nightly(mended, registry=registry).verdicts[0].outcome == "promote"


def test_who_forfeits_a_game_is_not_promoted_unless_its_gate_allows_that(tmp_path: Path) -> None:
    """It plays well, and now and then puts its mark where another is."""
    config = examples.config(gate={"elo1": 60})
    registry = league_of(tmp_path, WEAK, examples.graph(True, True, examples.CENTRE_FIRST, faulty=True), config=config)
    registry.set_alias(examples.LEAGUE, "champion", 1, expected=None, actor="me", reason="first")
    (refused,) = nightly(config, registry=registry).verdicts
    assert (refused.outcome, refused.promoted) == ("reject", False)
    assert re.fullmatch(r"it forfeited \d+ games, and its gate allows none", str(refused.note))
    assert refused.llr >= refused.bounds[1]
    verify(refused.verdict, registry=registry)
    lenient = examples.config(gate={"elo1": 60, "forfeits": True})
    verdicts.void(registry, refused.verdict, actor="me", reason="the gate was too strict")
    assert nightly(lenient, registry=registry).champion == "tictactoe@2"
