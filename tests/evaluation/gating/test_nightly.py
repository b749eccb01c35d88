import json
import math
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from filelock import FileLock

from evaluation.documents import Progress
from evaluation.gating import verdicts
from evaluation.gating.evidence import VerdictReport
from evaluation.gating.nightly import NightlyReport, nightly
from evaluation.gating.verification import verify
from evaluation.matches import tournament
from evaluation.matches.leaderboard import CountedGames
from league.config.league import LeagueConfig
from league.environments.building import interface
from league.errors import AlreadyRunning, ConfigError
from league.histograms import BOUNDS
from league.registry.aliases import ANY
from league.registry.registry import Registry
from league.registry.storage.rows import ShadowCounts
from league.registry.verdicts import VerdictRepository
from league.results.ledger import Ledger
from league.settings import Storage
from policy_league.cli.output import verdict as verdict_line
from tests.support.crashes import ProcessDeath, crash_after
from tests.support.leagues import tictactoe
from tests.support.leagues.judged_league import CONFIG, MIDDLING, STRONG, STRONGEST, WEAK, league_of
from tests.support.policies.graphs import masked_mlp


@pytest.fixture(autouse=True, scope="module")
def few_rating_matches() -> Iterator[None]:
    """Otherwise half of a run's games are for ratings."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("evaluation.gating.nightly.RATING_BLOCKS", 6)
        yield


@pytest.fixture
def registry(tmp_path: Path) -> Iterator[Registry]:
    opened = league_of(tmp_path / "home", WEAK, MIDDLING, STRONG, MIDDLING)
    yield opened
    opened.close()


@dataclass(frozen=True)
class FirstRun:
    """A nightly run that has ended: the home of its league, its report and what its listener was told."""

    home: Path
    report: NightlyReport
    events: list[Progress | VerdictReport]


@pytest.fixture(scope="module")
def first_run(tmp_path_factory: pytest.TempPathFactory) -> FirstRun:
    home, events = tmp_path_factory.mktemp("judged"), list[Progress | VerdictReport]()
    with closing(league_of(home, WEAK, MIDDLING, STRONG, MIDDLING)) as registry:
        return FirstRun(home, nightly(CONFIG, registry=registry, listener=events.append), events)


@pytest.fixture
def judged(first_run: FirstRun, tmp_path: Path) -> Iterator[Registry]:
    """The same league after its first nightly run."""
    with closing(_copy(first_run.home, tmp_path / "judged")) as opened:
        yield opened


def state(registry: Registry) -> dict[str, Any]:
    """All data that a nightly run leaves, without its timestamps."""
    return {
        "matches": Ledger(registry).matches(league=tictactoe.LEAGUE),
        "verdicts": [(v.id, v.outcome, v.evidence) for v in registry.verdicts.all(tictactoe.LEAGUE)],
        "champions": [(e.version, e.previous, e.verdict) for e in registry.aliases.history(tictactoe.LEAGUE)],
        "nights": [(n.candidates, n.alpha, n.ended_at is None) for n in registry.nightly_runs.all(tictactoe.LEAGUE)],
    }


def outcomes(report: NightlyReport) -> list[tuple[str, str, str, bool]]:
    return [(v.candidate, v.opponent, v.outcome, v.promoted) for v in report.verdicts]


def test_a_nightly_run_promotes_the_strongest_version(first_run: FirstRun, judged: Registry) -> None:
    report, events = first_run.report, first_run.events
    assert outcomes(report) == [
        ("tictactoe@1", "script:random", "reject", False),
        ("tictactoe@2", "script:random", "promote", True),
        ("tictactoe@3", "tictactoe@2", "promote", True),
        ("tictactoe@4", "tictactoe@3", "reject", False),
    ]
    assert (report.champion_before, report.champion, report.faults) == (None, "tictactoe@3", ())
    assert judged.aliases.current(tictactoe.LEAGUE) == {"champion": 3}
    assert [standing.ref for standing in report.leaderboard][:2] == ["script:one_ply", "tictactoe@3"]
    assert all(standing.rating is not None for standing in report.leaderboard)
    assert [each for each in events if isinstance(each, VerdictReport)] == list(report.verdicts)
    assert any(isinstance(each, Progress) and each.llr for each in events)
    assert json.loads(json.dumps(report.to_json(), allow_nan=False))["champion"] == "tictactoe@3"


def test_promotions_have_actor_reason_and_verdict(judged: Registry) -> None:
    event = judged.aliases.history(tictactoe.LEAGUE)[0]
    assert event.verdict == judged.verdicts.all(tictactoe.LEAGUE)[2].id
    assert event.actor == "league nightly"
    assert "beat tictactoe@2" in event.reason


def test_verdicts_have_their_evidence(judged: Registry) -> None:
    for row in judged.verdicts.all(tictactoe.LEAGUE):
        assert row.evidence is not None
        assert sum(row.evidence["counts"]) == row.evidence["blocks"] == row.evidence["games"] / 2
        lower, upper = row.evidence["bounds"]
        assert (row.evidence["llr"] >= upper) == (row.outcome == "promote")
        assert (row.evidence["llr"] <= lower) == (row.outcome == "reject")
        assert 0 < row.evidence["unique_games"] <= row.evidence["games"]


def test_the_next_run_has_nothing_to_do(judged: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    state_before = state(judged)
    monkeypatch.setattr(tournament, "match_worker", None)
    report = nightly(CONFIG, registry=judged)
    assert report.verdicts == ()
    assert (report.champion_before, report.champion) == ("tictactoe@3", "tictactoe@3")
    assert state(judged) == state_before


def test_a_new_version_is_tested_against_the_current_champion(judged: Registry) -> None:
    tictactoe.publish(judged, STRONGEST)
    judged.aliases.set(tictactoe.LEAGUE, "champion", 2, expected=3, actor="me", reason="by hand")
    report = nightly(CONFIG, registry=judged)
    assert outcomes(report) == [("tictactoe@5", "tictactoe@2", "promote", True)]


def test_an_even_match_keeps_the_champion(tmp_path: Path) -> None:
    config = tictactoe.config(gate={"elo0": -20, "elo1": 20, "max_blocks": 30})
    registry = league_of(tmp_path, STRONG, STRONG, config=config)
    registry.aliases.set(tictactoe.LEAGUE, "champion", 1, expected=None, actor="me", reason="first")
    report = nightly(config, registry=registry)
    assert outcomes(report) == [("tictactoe@2", "tictactoe@1", "inconclusive", False)]
    assert report.champion == "tictactoe@1"


def test_an_identical_policy_is_not_promoted(tmp_path: Path) -> None:
    """The two games of a block are the same game with exchanged sides: the score is exactly 0.5, and the candidate is
    rejected.
    """
    registry = league_of(tmp_path, STRONG, STRONG)
    registry.aliases.set(tictactoe.LEAGUE, "champion", 1, expected=None, actor="me", reason="first")
    report = nightly(CONFIG, registry=registry)
    assert outcomes(report) == [("tictactoe@2", "tictactoe@1", "reject", False)]
    assert report.verdicts[0].score == pytest.approx(0.5)
    assert report.verdicts[0].unique_games <= report.verdicts[0].games / 2


@pytest.mark.slow
@pytest.mark.usefixtures("ray_session")
def test_the_number_of_workers_does_not_change_the_result(registry: Registry, judged: Registry) -> None:
    nightly(CONFIG, registry=registry, workers=2)
    assert state(registry) == state(judged)


@pytest.mark.parametrize("every", [15, pytest.param(1, marks=pytest.mark.slow)])
def test_a_run_that_died_after_any_transaction_continues(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, every: int
) -> None:
    """After a crash at each single transaction, the final state equals that of an uninterrupted run."""
    gate = {"elo1": 150, "max_blocks": 100, "nights": 2, "alpha": 0.2, "anchors": ["script:random"], "margin": 150}
    config = tictactoe.config(gate=gate, play={"opening_plies": 2, "num_envs": 32})
    league_of(tmp_path / "fresh", MIDDLING, STRONG, config=config).close()
    quiet = _copy(tmp_path / "fresh", tmp_path / "quiet")
    with crash_after(0, monkeypatch) as count:
        nightly(config, registry=quiet)
    expected, writes = state(quiet), count[0]
    assert writes > 15
    assert [version for version, _, _ in expected["champions"]] == [2, 1]
    for crash_at in range(writes, 0, -every):
        registry = _copy(tmp_path / "fresh", tmp_path / str(crash_at))
        with crash_after(crash_at, monkeypatch), pytest.raises(ProcessDeath):
            nightly(config, registry=registry)
        report = nightly(config, registry=registry)
        assert state(registry) == expected, f"after transaction {crash_at}"
        assert report.champion == "tictactoe@2"
        registry.close()


@pytest.mark.parametrize("every", [30, pytest.param(6, marks=pytest.mark.slow)])
def test_candidates_are_tested_with_the_search_of_the_champion(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, every: int
) -> None:
    """Also after a crash at transactions of the nightly run."""

    def tested(registry: Registry) -> object:
        """The number of the search version that is published for the test may differ, and hence seeds of its games."""
        content = state(registry)
        rows = registry.verdicts.all(tictactoe.LEAGUE)
        searches = [registry.versions.get(row.league, row.candidate).search for row in rows]
        candidates = [search and (search.version, search.rule, search.simulations) for search in searches]
        return candidates, [row.outcome for row in rows], len(content["matches"]), content["nights"]

    gate = {"max_blocks": 4, "nights": 2, "confirmation_blocks": 0}
    config = tictactoe.config(gate=gate, play={"opening_plies": 2, "num_envs": 32})
    with closing(league_of(tmp_path / "fresh", config=config)) as fresh:
        value = masked_mlp((3, 3, 2), 9, has_value=True)
        tictactoe.publish(fresh, masked_mlp((3, 3, 2), 9), value=value)
        fresh.publisher.publish_search(tictactoe.LEAGUE, 1, "gumbel", 4, 1.0)
        fresh.aliases.set(tictactoe.LEAGUE, "champion", 2, expected=ANY, actor="test", reason="test")
        tictactoe.publish(fresh, masked_mlp((3, 3, 2), 9, seed=1), value=value)
        fresh.publisher.publish_search(tictactoe.LEAGUE, 3, "puct", 4, 1.0)
        tictactoe.publish(fresh, MIDDLING)  # without a value
    quiet = _copy(tmp_path / "fresh", tmp_path / "quiet")
    with crash_after(0, monkeypatch) as count:
        report = nightly(config, registry=quiet)
    assert [verdict.candidate for verdict in report.verdicts] == ["tictactoe@6", "tictactoe@4", "tictactoe@5"]
    assert str(quiet.versions.get(tictactoe.LEAGUE, 6).search).startswith("@3, 4 simulations, gumbel, ")
    assert report.faults == ()
    assert [night.candidates for night in quiet.nightly_runs.all(tictactoe.LEAGUE)] == [(3, 4, 5)]
    assert nightly(config, registry=quiet).verdicts == ()
    expected = tested(quiet)
    with closing(_copy(tmp_path / "quiet", tmp_path / "plain")) as plain:
        plain.aliases.set(tictactoe.LEAGUE, "champion", 1, expected=ANY, actor="test", reason="test")
        nightly(config, registry=plain)
        candidates = {row.candidate for row in plain.verdicts.all(tictactoe.LEAGUE)}
    assert 3 not in candidates, "it was tested with the search of the former champion"
    for crash_at in range(count[0], 0, -every):
        with closing(_copy(tmp_path / "fresh", tmp_path / str(crash_at))) as registry:
            with crash_after(crash_at, monkeypatch), pytest.raises(ProcessDeath):
                nightly(config, registry=registry)
            nightly(config, registry=registry)
            assert tested(registry) == expected, f"after transaction {crash_at}"


def _copy(home: Path, to: Path) -> Registry:
    shutil.copytree(home, to)
    return Registry.open(Storage.at(to))


KILLED = """
import os, signal, sys
from league.registry.registry import Registry
from league.registry.verdicts import VerdictRepository
from league.settings import Storage
from evaluation.gating.nightly import nightly
from evaluation.gating.evidence import VerdictReport
from tests.support.leagues.judged_league import CONFIG

verdicts = 0
def listener(progress):
    global verdicts
    verdicts += isinstance(progress, VerdictReport)
    if verdicts == 1 and not isinstance(progress, VerdictReport) and progress.played:
        os.kill(os.getpid(), signal.SIGKILL)
nightly(CONFIG, registry=Registry.open(Storage.at(sys.argv[1])), listener=listener)
"""


@pytest.mark.slow
def test_a_killed_run_continues(registry: Registry, judged: Registry) -> None:
    command = [sys.executable, "-c", KILLED, str(registry.storage.home)]
    killed = subprocess.run(command, cwd=Path(__file__).parents[3], timeout=120, check=False)
    assert killed.returncode == -signal.SIGKILL
    assert [verdict.outcome for verdict in registry.verdicts.all(tictactoe.LEAGUE)] == ["reject", None]
    report = nightly(CONFIG, registry=registry)
    assert [verdict.candidate for verdict in report.verdicts] == ["tictactoe@2", "tictactoe@3", "tictactoe@4"]
    assert state(registry) == state(judged)


def test_a_concurrent_run_is_rejected(judged: Registry) -> None:
    home = judged.storage.home
    (home / "locks").mkdir(exist_ok=True)
    with FileLock(home / "locks" / "nightly-tictactoe.lock"), pytest.raises(AlreadyRunning, match="tictactoe"):
        nightly(CONFIG, registry=judged)
    assert nightly(CONFIG, registry=judged).champion == "tictactoe@3"


def test_a_champion_moved_during_the_test_is_not_overruled(registry: Registry) -> None:
    """The candidate has beaten version 2, but in the meantime a person has promoted version 1."""

    def interfere(event: Progress | VerdictReport) -> None:
        if isinstance(event, Progress) and event.what == "tictactoe@3 against tictactoe@2" and not event.played:
            registry.aliases.set(tictactoe.LEAGUE, "champion", 1, expected=2, actor="me", reason="by hand")

    report = nightly(CONFIG, registry=registry, listener=interfere)
    rejected = report.verdicts[2]
    assert (rejected.outcome, rejected.promoted) == ("promote", False)
    assert rejected.note is not None
    assert "tictactoe@1 now" in rejected.note
    assert registry.aliases.history(tictactoe.LEAGUE)[0].version == 4, "version 4 has beaten version 1 later in the run"
    again = nightly(CONFIG, registry=registry)
    assert outcomes(again) == [("tictactoe@3", "tictactoe@4", "promote", True)]


def test_a_refusal_by_a_former_champion_does_not_count(tmp_path: Path) -> None:
    """The candidate is weaker than version 2, but in the meantime a person has restored version 1."""
    registry = league_of(tmp_path / "home", WEAK, STRONGEST, MIDDLING, config=CONFIG)
    for version, expected in ((1, None), (2, 1)):
        registry.aliases.set(tictactoe.LEAGUE, "champion", version, expected=expected, actor="me", reason="by hand")

    def interfere(event: Progress | VerdictReport) -> None:
        if isinstance(event, Progress) and event.what == "tictactoe@3 against tictactoe@2" and not event.played:
            registry.aliases.rollback(tictactoe.LEAGUE, actor="me", reason="crashes in production")

    found = outcomes(nightly(CONFIG, registry=registry, listener=interfere))
    assert ("tictactoe@3", "tictactoe@2", "void", False) in found
    assert ("tictactoe@3", "tictactoe@1", "promote", True) in outcomes(nightly(CONFIG, registry=registry))
    registry.close()


def test_a_version_that_was_rolled_back_is_not_promoted_again(tmp_path: Path) -> None:
    """It became champion by hand, so that it has no verdict."""
    registry = league_of(tmp_path / "home", WEAK, STRONGEST, config=CONFIG)
    for version, expected in ((1, None), (2, 1)):
        registry.aliases.set(tictactoe.LEAGUE, "champion", version, expected=expected, actor="me", reason="by hand")
    registry.aliases.rollback(tictactoe.LEAGUE, actor="me", reason="crashes in production")
    report = nightly(CONFIG, registry=registry)
    assert (outcomes(report), report.champion) == ([], "tictactoe@1")
    registry.close()


def test_an_open_verdict_against_a_former_champion_is_voided(registry: Registry) -> None:
    row = registry.leagues.get(tictactoe.LEAGUE)
    registry.aliases.set(tictactoe.LEAGUE, "champion", 2, expected=None, actor="me", reason="first")
    verdict = verdicts.open_verdict(registry, row, 3, "tictactoe@2")
    registry.aliases.set(tictactoe.LEAGUE, "champion", 4, expected=2, actor="me", reason="by hand")
    report = nightly(CONFIG, registry=registry)
    assert outcomes(report)[0] == ("tictactoe@3", "tictactoe@2", "void", False)
    assert ("tictactoe@3", "tictactoe@4", "promote", True) in outcomes(report)
    assert registry.verdicts.all(tictactoe.LEAGUE)[0].id == verdict.id


def test_a_voided_verdict_is_followed_by_new_games(registry: Registry) -> None:
    row = registry.leagues.get(tictactoe.LEAGUE)
    first = verdicts.open_verdict(registry, row, 3, "script:random")
    registry.verdicts.close(first.id, "void", {})
    second = verdicts.open_verdict(registry, row, 3, "script:random")
    assert second.id != first.id
    assert second.id == verdicts.open_verdict(registry, row, 3, "script:random").id


def test_a_rolled_back_promotion_is_not_repeated(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    """The process dies between promotion and closing its verdict, and a person rolls back before the next run."""
    with monkeypatch.context() as patch:
        patch.setattr(VerdictRepository, "close", _crash_on_promotion(VerdictRepository.close))
        with pytest.raises(ProcessDeath):
            nightly(CONFIG, registry=registry)
    assert registry.aliases.current(tictactoe.LEAGUE) == {"champion": 3}
    registry.aliases.rollback(tictactoe.LEAGUE, actor="me", reason="no")
    report = nightly(CONFIG, registry=registry)
    assert outcomes(report)[0] == ("tictactoe@3", "tictactoe@2", "promote", True)
    assert registry.aliases.current(tictactoe.LEAGUE) == {"champion": 2}
    assert [e.kind for e in registry.aliases.history(tictactoe.LEAGUE)] == ["rollback", "set", "set"]


def _crash_on_promotion(close: Any) -> Any:
    def crash(verdicts: VerdictRepository, verdict: str, outcome: str, evidence: dict[str, Any]) -> None:
        if outcome == "promote" and evidence["candidate"] == "tictactoe@3":
            raise ProcessDeath
        close(verdicts, verdict, outcome, evidence)

    return crash


def test_a_tampered_version_is_reported_and_the_others_are_tested(registry: Registry) -> None:
    (registry.artifacts.root / "tictactoe" / "3" / "shared.onnx").write_bytes(STRONGEST)
    report = nightly(CONFIG, registry=registry)
    assert report.champion == "tictactoe@2"
    assert [verdict.candidate for verdict in report.verdicts] == ["tictactoe@1", "tictactoe@2", "tictactoe@4"]
    assert any("tictactoe@3" in fault and "shared.onnx" in fault for fault in report.faults)


def test_an_empty_league_has_an_empty_report(tmp_path: Path) -> None:
    report = nightly(CONFIG, registry=league_of(tmp_path))
    assert (report.verdicts, report.leaderboard, report.champion) == ((), (), None)


def test_an_unwritable_home_is_reported_in_one_line(registry: Registry) -> None:
    locks = registry.storage.home / "locks"
    locks.write_text("in the way")
    with pytest.raises(Exception, match="cannot be locked") as error:
        nightly(CONFIG, registry=registry)
    assert "\n" not in str(error.value)


def test_hypotheses_out_of_range_are_rejected() -> None:
    with pytest.raises(ConfigError, match="elo1"):
        tictactoe.config(gate={"elo1": 400})


def test_a_candidate_without_the_required_shadow_traffic_is_not_tested(tmp_path: Path) -> None:
    gate = {"shadow_agreement": 0.5, "latency_ms": 10, "shadow_observations": 10}
    config = tictactoe.config(play={"opening_plies": 2, "num_envs": 32}, gate=gate)
    registry = league_of(tmp_path / "home", MIDDLING, STRONG, STRONGEST, config=config)
    registry.aliases.set(tictactoe.LEAGUE, "champion", 1, expected=None, actor="test", reason="test")
    latency = (0, 100, *[0] * (len(BOUNDS) - 1))
    shown = [ShadowCounts(tictactoe.LEAGUE, 3, 1, 100, 100, 60, 0, 0, 0, latency, 4_000_000)]
    registry.replicas.write_report("replica-1", {}, shown)
    report = nightly(config, registry=registry)
    assert outcomes(report) == [
        ("tictactoe@2", "tictactoe@1", "void", False),
        ("tictactoe@3", "tictactoe@1", "promote", True),
    ]
    assert report.verdicts[0].games == 0
    assert "has 0 observations as the champion's shadow" in str(report.verdicts[0].note)
    registry.close()


def test_members_of_a_champion_are_shadowed_in_its_place(tmp_path: Path) -> None:
    gate = {"shadow_agreement": 0.5, "shadow_observations": 150}
    config = tictactoe.config(play={"opening_plies": 2, "num_envs": 32}, gate=gate)
    registry = league_of(tmp_path / "home", MIDDLING, MIDDLING, STRONGEST, config=config)
    mixture = registry.publisher.publish_mixture(tictactoe.LEAGUE, {1: 0.5, 2: 0.5}).number
    registry.aliases.set(tictactoe.LEAGUE, "champion", mixture, expected=None, actor="test", reason="test")
    latency = (0, 100, *[0] * (len(BOUNDS) - 1))
    shown = [ShadowCounts(tictactoe.LEAGUE, 3, of, 100, 100, 60, 0, 0, 0, latency, 4_000_000) for of in (1, 2)]
    registry.replicas.write_report("replica-1", {}, shown)
    outcome = {ref: (result, note) for ref, _, result, note in outcomes(nightly(config, registry=registry))}
    assert outcome["tictactoe@3"] == ("promote", True)
    registry.close()


def test_the_latency_limit_applies_to_the_slowest_requests(tmp_path: Path) -> None:
    """Nine of ten observations took 50 µs, the others up to 250 ms: the median is within the limit, the tail is not."""
    config = tictactoe.config(play={"opening_plies": 2, "num_envs": 32}, gate={"latency_ms": 10})
    registry = league_of(tmp_path / "home", MIDDLING, STRONG, config=config)
    registry.aliases.set(tictactoe.LEAGUE, "champion", 1, expected=None, actor="test", reason="test")
    latency = [0] * (len(BOUNDS) + 1)
    latency[1], latency[BOUNDS.index(250_000)] = 900, 100
    shown = [ShadowCounts(tictactoe.LEAGUE, 2, 1, 1000, 1000, 1000, 0, 0, 0, tuple(latency), 4_000_000)]
    registry.replicas.write_report("replica-1", {}, shown)
    report = nightly(config, registry=registry)
    assert outcomes(report) == [("tictactoe@2", "tictactoe@1", "void", False)]
    assert "ms" in str(report.verdicts[0].note)
    registry.close()


def test_shadow_traffic_is_not_required_without_a_champion(tmp_path: Path) -> None:
    config = tictactoe.config(play={"opening_plies": 2, "num_envs": 32}, gate={"shadow_agreement": 1.0})
    registry = league_of(tmp_path / "home", STRONG, config=config)
    assert outcomes(nightly(config, registry=registry)) == [("tictactoe@1", "script:random", "promote", True)]
    registry.close()


def with_yearly_alpha(**gate: Any) -> LeagueConfig:
    return tictactoe.config(play={"opening_plies": 2, "num_envs": 32}, gate={"nights": 365, "max_blocks": 1000} | gate)


def test_the_alpha_of_a_night_is_divided_among_its_candidates(tmp_path: Path) -> None:
    config = with_yearly_alpha()
    registry = league_of(tmp_path, MIDDLING, STRONG, config=config)
    report = nightly(config, registry=registry)
    assert [verdict.alpha for verdict in report.verdicts] == [pytest.approx(0.05 / 365 / 2)] * 2
    assert report.alpha_spent == pytest.approx(0.05 / 365)
    assert report.verdicts[0].bounds[1] == pytest.approx(math.log(0.95 / (0.05 / 730)))
    assert report.champion == "tictactoe@2"
    tictactoe.publish(registry, STRONGEST)
    second = nightly(config, registry=registry)
    assert [verdict.alpha for verdict in second.verdicts] == [pytest.approx(0.05 / 365)]
    first_row, second_row = registry.nightly_runs.all(tictactoe.LEAGUE)
    assert (first_row.candidates, second_row.candidates) == ((1, 2), (3,))
    assert second_row.report == second.to_json()


def test_without_remaining_alpha_nothing_is_tested(tmp_path: Path) -> None:
    config = with_yearly_alpha(nights=1)
    registry = league_of(tmp_path, MIDDLING, config=config)
    nightly(config, registry=registry)
    tictactoe.publish(registry, STRONG)
    report = nightly(config, registry=registry)
    assert (report.verdicts, report.alpha_spent) == ((), pytest.approx(0.05))
    assert "spent all of gate.alpha (0.05); for more than 1 nightly runs per year" in report.faults[0]
    enough = with_yearly_alpha(nights=1, alpha=0.1)
    assert nightly(enough, registry=registry).champion == "tictactoe@2"


def test_versions_published_during_a_run_are_tested_in_the_next(tmp_path: Path) -> None:
    """The run is killed after one of two verdicts; a third version is published before it is resumed."""
    config = with_yearly_alpha()
    registry = league_of(tmp_path, MIDDLING, STRONG, config=config)

    def die(event: Progress | VerdictReport) -> None:
        if isinstance(event, VerdictReport):
            raise ProcessDeath

    with pytest.raises(ProcessDeath):
        nightly(config, registry=registry, listener=die)
    tictactoe.publish(registry, STRONGEST)
    report = nightly(config, registry=registry)
    part = 0.05 / 365
    assert [(v.candidate, v.alpha) for v in report.verdicts] == [
        ("tictactoe@2", pytest.approx(part / 2)),
        ("tictactoe@3", pytest.approx(part)),
    ]
    assert [row.candidates for row in registry.nightly_runs.all(tictactoe.LEAGUE)] == [(1, 2), (3,)]
    assert all(row.ended_at for row in registry.nightly_runs.all(tictactoe.LEAGUE))


def test_a_verdict_voided_during_its_test_spends_its_alpha(tmp_path: Path) -> None:
    config = with_yearly_alpha(elo0=-20, elo1=20, max_blocks=200)
    registry = league_of(tmp_path, STRONG, STRONG, WEAK, config=config)
    registry.aliases.set(tictactoe.LEAGUE, "champion", 1, expected=None, actor="me", reason="first")

    def stop(event: Progress | VerdictReport) -> None:
        if isinstance(event, Progress) and event.what == "tictactoe@2 against tictactoe@1" and event.played:
            verdicts.void(registry, registry.verdicts.all(tictactoe.LEAGUE)[0].id, actor="me", reason="looks bad")

    report = nightly(config, registry=registry, listener=stop)
    stopped, other = report.verdicts
    assert (stopped.outcome, stopped.note) == ("void", "voided by me: looks bad")
    assert 0 < stopped.blocks < 200
    assert other.outcome != "void"
    assert report.alpha_spent == pytest.approx(stopped.alpha + other.alpha) == pytest.approx(0.05 / 365)
    again = nightly(config, registry=registry)
    assert [verdict.candidate for verdict in again.verdicts] == ["tictactoe@2"], "tested again with new games"
    assert again.alpha_spent == pytest.approx(2 * 0.05 / 365)


def test_purged_games_are_kept_but_ignored(judged: Registry) -> None:
    first = judged.verdicts.all(tictactoe.LEAGUE)[1]
    assert first.evidence is not None
    league = judged.leagues.get(tictactoe.LEAGUE)
    number = CountedGames(judged, league).matches
    verdicts.void(judged, first.id, actor="me", reason="a broken machine", purge=True)
    row = judged.verdicts.get(first.id)
    assert row.outcome == "void"
    own = [row.schedule, row.confirmation, *(test["schedule"] for test in row.tests)]
    played = sum(len(Ledger(judged).positions(schedule)) for schedule in own)
    assert CountedGames(judged, league).matches == number - played
    assert len(Ledger(judged).matches(league=tictactoe.LEAGUE, schedule=row.schedule)) >= first.evidence["blocks"]
    assert verify(first.id, registry=judged).outcome == "void"


def test_a_promotion_is_confirmed_by_new_games_of_fixed_number(first_run: FirstRun, judged: Registry) -> None:
    report = first_run.report
    promoted = [verdict for verdict in report.verdicts if verdict.promoted]
    assert [gain.verdict for gain in report.confirmations] == [verdict.verdict for verdict in promoted]
    for gain, verdict in zip(report.confirmations, promoted, strict=True):
        low, high = gain.interval
        assert gain.games == 40
        assert low is not None
        assert high is not None
        assert low < gain.elo < high
        row = judged.verdicts.get(verdict.verdict)
        fresh = Ledger(judged).matches(league=tictactoe.LEAGUE, schedule=row.confirmation)
        counted = Ledger(judged).matches(league=tictactoe.LEAGUE, schedule=row.schedule)
        assert {match.seed for match in fresh}.isdisjoint(match.seed for match in counted)
    assert nightly(CONFIG, registry=judged).confirmations == ()


def test_returns_are_tested_by_betting_if_configured(tmp_path: Path) -> None:
    """For a league with one side: returns of mpe2.simple are between -100 and 0 here."""
    gate = {"model": "returns", "return_bound": 100, "margin": 10, "nights": None, "confirmation_blocks": 10}
    environment = {"entry_point": "mpe2.simple_v3", "kwargs": {"max_cycles": 12}}
    config = LeagueConfig.from_mapping({"league": "kind", "environment": environment, "gate": gate})
    registry = Registry.open(Storage.at(tmp_path))
    registry.leagues.register(config, interface(config))
    spaces = registry.leagues.get("kind").interface.of_policy("shared")
    for graph in (tictactoe.linear(spaces, 3), tictactoe.chase_landmark(spaces), tictactoe.linear(spaces, 3)):
        tictactoe.publish(registry, graph, "kind")
    registry.aliases.set("kind", "champion", 1, expected=None, actor="me", reason="first")
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


def test_a_return_beyond_the_bound_is_reported_and_the_verdict_can_be_voided(tmp_path: Path) -> None:
    gate = {"model": "returns", "return_bound": 0.5, "margin": 0.2}
    config = tictactoe.config(gate=gate)
    registry = league_of(tmp_path, STRONG, config=config)
    report = nightly(config, registry=registry)
    assert report.verdicts == ()
    assert "gate.return_bound is 0.5, but the returns of a block differ by" in report.faults[0]
    verdicts.void(registry, registry.verdicts.all(tictactoe.LEAGUE)[0].id, actor="me", reason="bound")
    mended = tictactoe.config(gate=gate | {"return_bound": 2})
    assert nightly(mended, registry=registry).verdicts[0].outcome == "promote"


def test_a_forfeit_prevents_promotion_unless_the_gate_allows_it(tmp_path: Path) -> None:
    """The version plays well, but sometimes marks a taken square."""
    config = tictactoe.config(gate={"elo1": 60})
    registry = league_of(
        tmp_path, WEAK, tictactoe.graph(True, True, tictactoe.CENTRE_FIRST, faulty=True), config=config
    )
    registry.aliases.set(tictactoe.LEAGUE, "champion", 1, expected=None, actor="me", reason="first")
    (rejected,) = nightly(config, registry=registry).verdicts
    assert (rejected.outcome, rejected.promoted) == ("reject", False)
    assert re.fullmatch(r"it forfeited \d+ games, but the gate allows none", str(rejected.note))
    assert rejected.llr >= rejected.bounds[1]
    assert re.fullmatch(
        r"\d+ games: \d+ by an illegal action \(the first: action \d, legal: .*\)",
        str(rejected.forfeits["tictactoe@2"]),
    )
    assert f"; tictactoe@2 forfeited {rejected.forfeits['tictactoe@2']}" in verdict_line(rejected)
    verify(rejected.verdict, registry=registry)
    lenient = tictactoe.config(gate={"elo1": 60, "forfeits": True})
    verdicts.void(registry, rejected.verdict, actor="me", reason="the gate was too strict")
    assert nightly(lenient, registry=registry).champion == "tictactoe@2"
