import json
import math
import re
import shutil
from collections.abc import Callable, Iterator
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
from league.errors import AlreadyRunning
from league.histograms import BOUNDS
from league.registry.registry import Registry
from league.registry.storage.rows import ShadowCounts
from league.registry.verdicts import VerdictRepository
from league.results.ledger import Ledger
from league.settings import Storage
from policy_league.cli.output import verdict as verdict_line
from tests.support.crashes import ProcessDeath, after_crashes
from tests.support.leagues import tictactoe
from tests.support.leagues.judged_league import CONFIG, MIDDLING, STRONG, STRONGEST, WEAK, config, league_of, promote
from tests.support.leagues.tictactoe import LEAGUE
from tests.support.policies.graphs import masked_mlp
from tests.support.templates import copied


@pytest.fixture(autouse=True, scope="module")
def few_rating_matches() -> Iterator[None]:
    """Otherwise half of a run's games are for ratings."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("evaluation.gating.nightly.RATING_BLOCKS", 6)
        yield


@pytest.fixture
def registry(tmp_path: Path) -> Iterator[Registry]:
    with closing(league_of(tmp_path / "home", WEAK, MIDDLING, STRONG, MIDDLING)) as opened:
        yield opened


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
    with copied(first_run.home, tmp_path / "judged") as opened:
        yield opened


def state(registry: Registry) -> dict[str, Any]:
    """All data that a nightly run leaves, without its timestamps."""
    return {
        "matches": Ledger(registry).matches(league=LEAGUE),
        "verdicts": [(v.id, v.outcome, v.evidence) for v in registry.verdicts.all(LEAGUE)],
        "champions": [(e.version, e.previous, e.verdict) for e in registry.aliases.history(LEAGUE)],
        "nights": [(n.candidates, n.alpha, n.ended_at is None) for n in registry.nightly_runs.all(LEAGUE)],
    }


def outcomes(report: NightlyReport) -> list[tuple[str, str, str, bool]]:
    return [(v.candidate, v.opponent, v.outcome, v.promoted) for v in report.verdicts]


def during(contest: str, act: Callable[[], object], begun: bool = False) -> Callable[[Progress | VerdictReport], None]:
    """A listener that acts during a contest: before its first match, or afterwards."""

    def listener(event: Progress | VerdictReport) -> None:
        if isinstance(event, Progress) and event.what == contest and bool(event.played) == begun:
            act()

    return listener


def test_a_nightly_run_promotes_the_strongest_version(first_run: FirstRun, judged: Registry) -> None:
    report, events = first_run.report, first_run.events
    assert outcomes(report) == [
        ("tictactoe@1", "script:random", "reject", False),
        ("tictactoe@2", "script:random", "promote", True),
        ("tictactoe@3", "tictactoe@2", "promote", True),
        ("tictactoe@4", "tictactoe@3", "reject", False),
    ]
    assert (report.champion_before, report.champion, report.faults) == (None, "tictactoe@3", ())
    assert judged.aliases.current(LEAGUE) == {"champion": 3}
    assert [standing.ref for standing in report.leaderboard][:2] == ["script:one_ply", "tictactoe@3"]
    assert all(standing.rating is not None for standing in report.leaderboard)
    assert [event for event in events if isinstance(event, VerdictReport)] == list(report.verdicts)
    assert any(isinstance(event, Progress) and event.llr for event in events)
    assert json.loads(json.dumps(report.to_json(), allow_nan=False))["champion"] == "tictactoe@3"
    rows, promotion = judged.verdicts.all(LEAGUE), judged.aliases.history(LEAGUE)[0]
    assert (promotion.verdict, promotion.actor) == (rows[2].id, "league nightly")
    assert "beat tictactoe@2" in promotion.reason
    for row in rows:
        assert sum(row.evidence["counts"]) == row.evidence["blocks"] == row.evidence["games"] / 2
        lower, upper = row.evidence["bounds"]
        assert (row.evidence["llr"] >= upper) == (row.outcome == "promote")
        assert (row.evidence["llr"] <= lower) == (row.outcome == "reject")
        assert 0 < row.evidence["unique_games"] <= row.evidence["games"]


def test_a_promotion_is_confirmed_by_new_games_of_fixed_number(first_run: FirstRun, judged: Registry) -> None:
    promoted = [verdict for verdict in first_run.report.verdicts if verdict.promoted]
    confirmations = first_run.report.confirmations
    assert [gain.verdict for gain in confirmations] == [verdict.verdict for verdict in promoted]
    for gain in confirmations:
        low, high = gain.interval
        assert gain.games == 40
        assert low < gain.elo < high
        row = judged.verdicts.get(gain.verdict)
        fresh, counted = (Ledger(judged).matches(league=LEAGUE, schedule=s) for s in (row.confirmation, row.schedule))
        assert {match.seed for match in fresh}.isdisjoint(match.seed for match in counted)


def test_the_next_run_has_nothing_to_do(judged: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    state_before = state(judged)
    monkeypatch.setattr(tournament, "match_worker", None)
    report = nightly(CONFIG, registry=judged)
    assert (report.verdicts, report.confirmations) == ((), ())
    assert (report.champion_before, report.champion) == ("tictactoe@3", "tictactoe@3")
    assert state(judged) == state_before


def test_a_new_version_is_tested_against_the_current_champion(judged: Registry) -> None:
    tictactoe.publish(judged, STRONGEST)
    report = nightly(CONFIG, registry=promote(judged, 2))
    assert outcomes(report) == [("tictactoe@5", "tictactoe@2", "promote", True)]


def test_an_identical_policy_is_not_promoted(tmp_path: Path) -> None:
    """The two games of a block are the same game with exchanged sides: the score is exactly 0.5, and the candidate is
    rejected.
    """
    report = nightly(CONFIG, registry=promote(league_of(tmp_path, STRONG, STRONG), 1))
    assert outcomes(report) == [("tictactoe@2", "tictactoe@1", "reject", False)]
    assert report.verdicts[0].score == pytest.approx(0.5)
    assert report.verdicts[0].unique_games <= report.verdicts[0].games / 2


@pytest.mark.slow
@pytest.mark.usefixtures("ray_session")
def test_the_number_of_workers_does_not_change_the_result(registry: Registry, judged: Registry) -> None:
    nightly(CONFIG, registry=registry, workers=2)
    assert state(registry) == state(judged)


@pytest.mark.parametrize("every", [15, pytest.param(1, marks=pytest.mark.slow)])
def test_a_run_that_died_at_any_time_continues(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, every: int) -> None:
    """After a crash at each single transaction, the final state equals that of an uninterrupted run."""
    gate = {"elo1": 150, "max_blocks": 100, "nights": 2, "alpha": 0.2, "anchors": ["script:random"], "margin": 150}
    settings = config(**gate)
    league_of(tmp_path / "fresh", MIDDLING, STRONG, config=settings).close()
    runs = after_crashes(tmp_path / "fresh", lambda registry: nightly(settings, registry=registry), every, monkeypatch)
    writes, quiet = next(runs)
    expected = state(quiet)
    assert writes > 15
    assert [version for version, _, _ in expected["champions"]] == [2, 1]
    for crash_at, registry in runs:
        assert state(registry) == expected, f"after transaction {crash_at}"


@pytest.mark.parametrize("every", [30, pytest.param(6, marks=pytest.mark.slow)])
def test_candidates_search_as_the_champion_does(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, every: int) -> None:
    """Also after a crash at transactions of the nightly run."""

    def tested(registry: Registry) -> object:
        """The number of the search version that is published for the test may differ, and hence seeds of its games."""
        content, rows = state(registry), registry.verdicts.all(LEAGUE)
        searches = [registry.versions.get(row.league, row.candidate).search for row in rows]
        candidates = [search and (search.version, search.rule, search.simulations) for search in searches]
        return candidates, [row.outcome for row in rows], len(content["matches"]), content["nights"]

    settings = config(max_blocks=4, nights=2, confirmation_blocks=0)
    with closing(league_of(tmp_path / "fresh", config=settings)) as fresh:
        value = masked_mlp((3, 3, 2), 9, has_value=True)
        for seed, (number, rule) in enumerate(((1, "gumbel"), (3, "puct"))):
            tictactoe.publish(fresh, masked_mlp((3, 3, 2), 9, seed=seed), value=value)
            fresh.publisher.publish_search(LEAGUE, number, rule, 4, 1.0)
        promote(fresh, 2)
        tictactoe.publish(fresh, MIDDLING)  # without a value
    runs = after_crashes(tmp_path / "fresh", lambda registry: nightly(settings, registry=registry), every, monkeypatch)
    _, quiet = next(runs)
    report, again = quiet.nightly_runs.all(LEAGUE)[0].report, nightly(settings, registry=quiet)
    candidates = [verdict["candidate"] for verdict in report["verdicts"]]
    assert (candidates, report["faults"]) == (["tictactoe@6", "tictactoe@4", "tictactoe@5"], [])
    assert str(quiet.versions.get(LEAGUE, 6).search).startswith("@3, 4 simulations, gumbel, ")
    assert ([night.candidates for night in quiet.nightly_runs.all(LEAGUE)], again.verdicts) == ([(3, 4, 5)], ())
    expected = tested(quiet)
    with copied(quiet.storage.home, tmp_path / "plain") as plain:
        nightly(settings, registry=promote(plain, 1))
        numbers = {row.candidate for row in plain.verdicts.all(LEAGUE)}
    assert 3 not in numbers, "it was tested with the search of the former champion"
    for crash_at, registry in runs:
        assert tested(registry) == expected, f"after transaction {crash_at}"


def test_a_concurrent_run_is_rejected_and_an_unwritable_home_reported(judged: Registry) -> None:
    locks = judged.storage.home / "locks"
    locks.mkdir(exist_ok=True)
    with FileLock(locks / "nightly-tictactoe.lock"), pytest.raises(AlreadyRunning, match="tictactoe"):
        nightly(CONFIG, registry=judged)
    assert nightly(CONFIG, registry=judged).champion == "tictactoe@3"
    shutil.rmtree(locks)
    locks.write_text("in the way")
    with pytest.raises(Exception, match=r"^.*cannot be locked.*$"):
        nightly(CONFIG, registry=judged)


def test_a_champion_moved_during_the_test_is_not_overruled(registry: Registry) -> None:
    """The candidate has beaten version 2, but in the meantime a person has promoted version 1."""
    interfere = during("tictactoe@3 against tictactoe@2", lambda: promote(registry, 1))
    rejected = nightly(CONFIG, registry=registry, listener=interfere).verdicts[2]
    assert (rejected.outcome, rejected.promoted) == ("promote", False)
    assert "tictactoe@1 now" in rejected.note
    assert registry.aliases.history(LEAGUE)[0].version == 4, "version 4 has beaten version 1 later in the run"
    again = nightly(CONFIG, registry=registry)
    assert outcomes(again) == [("tictactoe@3", "tictactoe@4", "promote", True)]


def test_a_version_that_is_rolled_back_is_not_promoted_again(tmp_path: Path) -> None:
    """It became champion by hand, so that it has no verdict. What it refused, with the candidate being weaker, does
    not count.
    """
    registry = promote(league_of(tmp_path / "home", WEAK, STRONGEST, MIDDLING), 1, 2)

    def roll_back() -> None:
        registry.aliases.rollback(LEAGUE, actor="me", reason="crashes in production")

    report = nightly(CONFIG, registry=registry, listener=during("tictactoe@3 against tictactoe@2", roll_back))
    assert ("tictactoe@3", "tictactoe@2", "void", False) in outcomes(report)
    report = nightly(CONFIG, registry=registry)
    assert ("tictactoe@3", "tictactoe@1", "promote", True) in outcomes(report)
    assert not [verdict for verdict in report.verdicts if verdict.candidate == "tictactoe@2"]
    registry.close()


def test_an_open_verdict_against_a_former_champion_is_voided_and_followed_by_new_games(registry: Registry) -> None:
    row = promote(registry, 2).leagues.get(LEAGUE)
    verdict = verdicts.open_verdict(registry, row, 3, "tictactoe@2")
    assert verdicts.open_verdict(registry, row, 3, "tictactoe@2").id == verdict.id
    report = nightly(CONFIG, registry=promote(registry, 4))
    assert outcomes(report)[0] == ("tictactoe@3", "tictactoe@2", "void", False)
    assert ("tictactoe@3", "tictactoe@4", "promote", True) in outcomes(report)
    assert registry.verdicts.all(LEAGUE)[0].id == verdict.id
    again = verdicts.open_verdict(registry, row, 3, "tictactoe@2")
    assert again.id != verdict.id


def test_a_rolled_back_promotion_is_not_repeated(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    """The process dies between promotion and closing its verdict, and a person rolls back before the next run."""
    close = VerdictRepository.close

    def crash(verdicts: VerdictRepository, verdict: str, outcome: str, evidence: dict[str, Any]) -> None:
        if outcome == "promote" and evidence["candidate"] == "tictactoe@3":
            raise ProcessDeath
        close(verdicts, verdict, outcome, evidence)

    with monkeypatch.context() as patch:
        patch.setattr(VerdictRepository, "close", crash)
        with pytest.raises(ProcessDeath):
            nightly(CONFIG, registry=registry)
    assert registry.aliases.current(LEAGUE) == {"champion": 3}
    registry.aliases.rollback(LEAGUE, actor="me", reason="no")
    report = nightly(CONFIG, registry=registry)
    assert outcomes(report)[0] == ("tictactoe@3", "tictactoe@2", "promote", True)
    assert registry.aliases.current(LEAGUE) == {"champion": 2}
    assert [e.kind for e in registry.aliases.history(LEAGUE)] == ["rollback", "set", "set"]


def test_a_tampered_version_is_reported_and_the_others_are_tested(registry: Registry) -> None:
    (registry.artifacts.root / "tictactoe" / "3" / "shared.onnx").write_bytes(STRONGEST)
    report = nightly(CONFIG, registry=registry)
    assert report.champion == "tictactoe@2"
    assert [verdict.candidate for verdict in report.verdicts] == ["tictactoe@1", "tictactoe@2", "tictactoe@4"]
    assert any("tictactoe@3" in fault and "shared.onnx" in fault for fault in report.faults)


def test_an_empty_league_has_an_empty_report(tmp_path: Path) -> None:
    report = nightly(CONFIG, registry=league_of(tmp_path))
    assert (report.verdicts, report.leaderboard, report.champion) == ((), (), None)


def shadowed(home: Path, *graphs: bytes, **gate: object) -> Registry:
    """A league whose first version is champion, and whose gate requires shadow traffic."""
    return promote(league_of(home, *graphs, config=config(**gate)), 1)


def show(registry: Registry, candidate: int, champion: int, agreed: int, tail: int = 0) -> None:
    """Report 100 observations of a shadow that took 50 µs, and `tail` that took up to 250 ms."""
    latency = [0] * (len(BOUNDS) + 1)
    latency[1], latency[BOUNDS.index(250_000)] = 100, tail
    counts = ShadowCounts(LEAGUE, candidate, champion, 100 + tail, 100 + tail, agreed, 0, 0, 0, latency, 4_000_000)
    registry.replicas.write_report(f"replica-{champion}", {}, [counts])


def test_a_candidate_without_the_required_shadow_traffic_is_not_tested(tmp_path: Path) -> None:
    gate = {"shadow_agreement": 0.5, "latency_ms": 10, "shadow_observations": 10}
    registry = shadowed(tmp_path, MIDDLING, STRONG, STRONGEST, **gate)
    show(registry, 3, 1, agreed=60)
    report = nightly(config(**gate), registry=registry)
    assert outcomes(report) == [
        ("tictactoe@2", "tictactoe@1", "void", False),
        ("tictactoe@3", "tictactoe@1", "promote", True),
    ]
    assert report.verdicts[0].games == 0
    assert "has 0 observations as the champion's shadow" in str(report.verdicts[0].note)


def test_members_of_a_champion_are_shadowed_in_its_place(tmp_path: Path) -> None:
    gate = {"shadow_agreement": 0.5, "shadow_observations": 150}
    registry = shadowed(tmp_path, MIDDLING, MIDDLING, STRONGEST, **gate)
    promote(registry, registry.publisher.publish_mixture(LEAGUE, {1: 0.5, 2: 0.5}).number)
    for member in (1, 2):
        show(registry, 3, member, agreed=60)
    outcome = {ref: (result, note) for ref, _, result, note in outcomes(nightly(config(**gate), registry=registry))}
    assert outcome["tictactoe@3"] == ("promote", True)


def test_the_latency_limit_applies_to_the_slowest_requests(tmp_path: Path) -> None:
    """Nine of ten observations took 50 µs, the others up to 250 ms: the median is within the limit, the tail is not."""
    registry = shadowed(tmp_path, MIDDLING, STRONG, latency_ms=10)
    show(registry, 2, 1, agreed=111, tail=11)
    report = nightly(config(latency_ms=10), registry=registry)
    assert outcomes(report) == [("tictactoe@2", "tictactoe@1", "void", False)]
    assert "ms" in str(report.verdicts[0].note)


def test_shadow_traffic_is_not_required_without_a_champion(tmp_path: Path) -> None:
    report = nightly(config(shadow_agreement=1.0), registry=league_of(tmp_path, STRONG))
    assert outcomes(report) == [("tictactoe@1", "script:random", "promote", True)]


def with_yearly_alpha(**gate: Any) -> LeagueConfig:
    return config(**{"nights": 365, "max_blocks": 1000} | gate)


def test_the_alpha_of_a_night_is_divided_among_its_candidates(tmp_path: Path) -> None:
    settings = with_yearly_alpha()
    registry = league_of(tmp_path, MIDDLING, STRONG, config=settings)
    report = nightly(settings, registry=registry)
    assert [verdict.alpha for verdict in report.verdicts] == [pytest.approx(0.05 / 365 / 2)] * 2
    assert report.alpha_spent == pytest.approx(0.05 / 365)
    assert report.verdicts[0].bounds[1] == pytest.approx(math.log(0.95 / (0.05 / 730)))
    assert report.champion == "tictactoe@2"
    tictactoe.publish(registry, STRONGEST)
    second = nightly(settings, registry=registry)
    assert [verdict.alpha for verdict in second.verdicts] == [pytest.approx(0.05 / 365)]
    first_row, second_row = registry.nightly_runs.all(LEAGUE)
    assert (first_row.candidates, second_row.candidates) == ((1, 2), (3,))
    assert second_row.report == second.to_json()


def test_without_remaining_alpha_nothing_is_tested(tmp_path: Path) -> None:
    settings = with_yearly_alpha(nights=1)
    registry = league_of(tmp_path, MIDDLING, config=settings)
    nightly(settings, registry=registry)
    tictactoe.publish(registry, STRONG)
    report = nightly(settings, registry=registry)
    assert (report.verdicts, report.alpha_spent) == ((), pytest.approx(0.05))
    assert "spent all of gate.alpha (0.05); for more than 1 nightly runs per year" in report.faults[0]
    enough = with_yearly_alpha(nights=1, alpha=0.1)
    assert nightly(enough, registry=registry).champion == "tictactoe@2"


def test_versions_published_during_a_run_are_tested_in_the_next(tmp_path: Path) -> None:
    """The run is killed after one of two verdicts; a third version is published before it is resumed."""
    settings = with_yearly_alpha()
    registry = league_of(tmp_path, MIDDLING, STRONG, config=settings)

    def die(event: Progress | VerdictReport) -> None:
        if isinstance(event, VerdictReport):
            raise ProcessDeath

    with pytest.raises(ProcessDeath):
        nightly(settings, registry=registry, listener=die)
    tictactoe.publish(registry, STRONGEST)
    report, part = nightly(settings, registry=registry), 0.05 / 365
    assert [(v.candidate, v.alpha) for v in report.verdicts] == [
        ("tictactoe@2", pytest.approx(part / 2)),
        ("tictactoe@3", pytest.approx(part)),
    ]
    rows = registry.nightly_runs.all(LEAGUE)
    assert [row.candidates for row in rows] == [(1, 2), (3,)]
    assert all(row.ended_at for row in rows)


def test_a_verdict_voided_during_its_test_spends_its_alpha(tmp_path: Path) -> None:
    settings = with_yearly_alpha(elo0=-20, elo1=20, max_blocks=200)
    registry = promote(league_of(tmp_path, STRONG, STRONG, WEAK, config=settings), 1)

    def void() -> None:
        verdicts.void(registry, registry.verdicts.all(LEAGUE)[0].id, actor="me", reason="looks bad")

    stop = during("tictactoe@2 against tictactoe@1", void, begun=True)
    report = nightly(settings, registry=registry, listener=stop)
    stopped, other = report.verdicts
    assert (stopped.outcome, stopped.note) == ("void", "voided by me: looks bad")
    assert 0 < stopped.blocks < 200
    assert other.outcome != "void"
    assert report.alpha_spent == pytest.approx(stopped.alpha + other.alpha) == pytest.approx(0.05 / 365)
    again = nightly(settings, registry=registry)
    assert [verdict.candidate for verdict in again.verdicts] == ["tictactoe@2"], "tested again with new games"
    assert again.alpha_spent == pytest.approx(2 * 0.05 / 365)


def test_purged_games_are_kept_but_ignored(judged: Registry) -> None:
    first, league = judged.verdicts.all(LEAGUE)[1], judged.leagues.get(LEAGUE)
    number = CountedGames(judged, league).matches
    verdicts.void(judged, first.id, actor="me", reason="a broken machine", purge=True)
    row = judged.verdicts.get(first.id)
    assert row.outcome == "void"
    schedules = [row.schedule, row.confirmation, *(test["schedule"] for test in row.tests)]
    played = sum(len(Ledger(judged).positions(schedule)) for schedule in schedules)
    assert CountedGames(judged, league).matches == number - played
    assert len(Ledger(judged).matches(league=LEAGUE, schedule=row.schedule)) >= first.evidence["blocks"]
    assert verify(first.id, registry=judged).outcome == "void"


def test_returns_are_tested_by_betting_if_configured(tmp_path: Path) -> None:
    """For a league with one side: returns of mpe2.simple are between -100 and 0 here."""
    gate = {"model": "returns", "return_bound": 100, "margin": 10, "nights": None, "confirmation_blocks": 10}
    environment = {"entry_point": "mpe2.simple_v3", "kwargs": {"max_cycles": 12}}
    settings = LeagueConfig.from_mapping({"league": "kind", "environment": environment, "gate": gate})
    registry = Registry.open(Storage.at(tmp_path))
    registry.leagues.register(settings, interface(settings))
    spaces = registry.leagues.get("kind").interface.of_policy("shared")
    for graph in (tictactoe.linear(spaces, 3), tictactoe.chase_landmark(spaces), tictactoe.linear(spaces, 3)):
        tictactoe.publish(registry, graph, "kind")
    registry.aliases.set("kind", "champion", 1, expected=None, actor="me", reason="first")
    report = nightly(settings, registry=registry, workers=0)
    assert report.faults == ()
    better, worse = report.verdicts
    assert (better.outcome, better.bounds) == ("promote", pytest.approx((-math.log(20), math.log(20))))
    assert better.difference.mean > 0
    assert worse.outcome == "reject"
    assert report.confirmations[0].difference is not None
    for verdict in report.verdicts:
        verify(verdict.verdict, registry=registry, replays=3)


def test_a_return_beyond_the_bound_is_reported_and_the_verdict_can_be_voided(tmp_path: Path) -> None:
    returns = {"model": "returns", "margin": 0.2}
    narrow = config(**returns, return_bound=0.5)
    registry = league_of(tmp_path, STRONG, config=narrow)
    report = nightly(narrow, registry=registry)
    assert report.verdicts == ()
    assert "gate.return_bound is 0.5, but the returns of a block differ by" in report.faults[0]
    verdicts.void(registry, registry.verdicts.all(LEAGUE)[0].id, actor="me", reason="bound")
    assert nightly(config(**returns, return_bound=2), registry=registry).verdicts[0].outcome == "promote"


def test_a_forfeit_prevents_promotion_unless_the_gate_allows_it(tmp_path: Path) -> None:
    """The version plays well, but sometimes marks a taken square."""
    faulty = tictactoe.graph(True, True, tictactoe.CENTRE_FIRST, faulty=True)
    registry = promote(league_of(tmp_path, WEAK, faulty), 1)
    (rejected,) = nightly(config(elo1=60), registry=registry).verdicts
    assert (rejected.outcome, rejected.promoted) == ("reject", False)
    assert re.fullmatch(r"it forfeited \d+ games, but the gate allows none", str(rejected.note))
    assert rejected.llr >= rejected.bounds[1]
    lost = str(rejected.forfeits["tictactoe@2"])
    assert re.fullmatch(r"\d+ games: \d+ by an illegal action \(the first: action \d, legal: .*\)", lost)
    assert f"; tictactoe@2 forfeited {lost}" in verdict_line(rejected)
    verify(rejected.verdict, registry=registry)
    verdicts.void(registry, rejected.verdict, actor="me", reason="the gate was too strict")
    assert nightly(config(elo1=60, forfeits=True), registry=registry).champion == "tictactoe@2"
