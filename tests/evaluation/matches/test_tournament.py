"""Tournaments: how their matches are played, stored and watched, and `evaluate` from the request to the report."""

from __future__ import annotations

import itertools
import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import ray
from hypothesis import given, settings
from hypothesis import strategies as st

from evaluation.documents import Progress
from evaluation.gating.nightly import nightly
from evaluation.matches import tournament, watchdog
from evaluation.matches.game_loop import play_matches
from evaluation.matches.leaderboard import compute_leaderboard
from evaluation.matches.tournament import ReorderBuffer, chunks_of, evaluate, play_schedule
from evaluation.matches.watchdog import Deadline
from evaluation.matches.worker import MOST_WORKERS, MatchWorker, match_worker
from evaluation.playback.replay import recorded_game
from evaluation.schedules.builders import ANCHOR, round_robin
from evaluation.schedules.tournament_plan import Budget
from league.config.league import LeagueConfig
from league.environments import copies, lockstep
from league.environments.building import interface
from league.environments.implementation import stock_stepping
from league.errors import (
    ArtifactCorrupt,
    ConfigError,
    EnvironmentMismatch,
    GameCrashed,
    GameHung,
    InvalidInput,
    LeagueError,
    UnknownAlias,
    UnknownLeague,
    UnknownPolicy,
    UnknownVersion,
)
from league.interface import AgentInterface
from league.registry.registry import Registry
from league.results.ledger import Ledger
from league.results.records import Match, Schedule
from league.settings import Storage
from tests.support.environments.fuses import ACTIONS, LIGHT, Fuse
from tests.support.leagues import tictactoe
from tests.support.leagues.judged_league import promote, reconfigure
from tests.support.leagues.registries import config, registered
from tests.support.leagues.tictactoe import LEAGUE
from tests.support.leagues.tournaments import STRENGTHS, tournament_schedule


def league_at(home: Path, num_envs: int = 2) -> Registry:
    """Tic-tac-toe with three versions of increasing strength."""
    registry = tictactoe.registry(home, play={"opening_plies": 2, "num_envs": num_envs})
    for strength in STRENGTHS:
        tictactoe.publish(registry, tictactoe.graph(**strength))
    return registry


@pytest.fixture
def registry(tmp_path: Path) -> Iterator[Registry]:
    with closing(league_at(tmp_path / "home")) as opened:
        yield opened


def in_ledger(registry: Registry, league: str = LEAGUE) -> list[Match]:
    return Ledger(registry).matches(league=league)


def play_locally(registry: Registry, schedule: Schedule) -> list[Match]:
    """The matches of a single process, without the ledger."""
    config = registry.leagues.get(schedule.league).config.model_dump_json(by_alias=True)
    return match_worker(registry.storage, config).play(schedule, range(schedule.length))


def test_matches_are_stored_in_order_and_played_once(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    schedule, reports = tournament_schedule(registry), list[Progress]()
    matches = play_schedule(schedule, registry=registry, enough=lambda matches: len(matches) >= 10)
    assert len(matches) == 12
    matches = play_schedule(schedule, registry=registry, listener=reports.append)
    assert matches == in_ledger(registry) == play_locally(registry, schedule)
    assert [report.played for report in reports] == [12, *range(16, schedule.length, 4), schedule.length]
    assert reports[0].moves_per_second is None
    assert all(report.moves_per_second > 0 for report in reports[1:])
    monkeypatch.setattr(tournament, "match_worker", None)
    assert play_schedule(schedule, registry=registry) == matches


def test_a_schedule_of_another_game_is_rejected(registry: Registry) -> None:
    """With another environment, or with other openings."""
    schedule, row = tournament_schedule(registry), registry.leagues.get(LEAGUE)
    Ledger(registry).open(schedule)
    environment = {**row.config.environment.model_dump(), "kwargs": {"screen_height": 500}}
    for change in ({"environment": environment}, {"play": {"opening_plies": 5}}):
        reconfigure(registry, tictactoe.config(**change))
        with pytest.raises(EnvironmentMismatch, match="another game than league tictactoe has now"):
            play_schedule(schedule, registry=registry)


@settings(deadline=None)
@given(st.integers(0, 60), st.integers(1, 60), st.integers(1, 40))
def test_chunks_cover_the_missing_matches_and_keep_their_bounds(played: int, length: int, num_envs: int) -> None:
    """Bounds do not depend on the matches that were already played, nor on the length of the schedule. A chunk is as
    long as all earlier ones, within limits.
    """
    chunks = chunks_of(length, played, num_envs)
    assert [position for chunk in chunks for position in chunk] == list(range(played, length))
    bounds = {chunk.stop for chunk in chunks_of(1000, 0, num_envs)}
    assert all(chunk.stop in bounds or chunk.stop == length for chunk in chunks)
    for number, ends in {2: [1, 2, 4, 8, 12, 16], 3: [2, 4, 8, 14, 20], 512: [256, 512, 1024, 2048, 3072]}.items():
        assert [chunk.stop for chunk in chunks_of(ends[-1], 0, number)] == ends


@given(st.permutations(range(12)), st.lists(st.booleans(), min_size=12, max_size=12))
def test_items_are_returned_in_order_as_soon_as_possible(order: list[int], looks: list[bool]) -> None:
    """looks: whether available items are taken after each insertion."""
    queue: ReorderBuffer[str] = ReorderBuffer()
    out: list[str] = []
    for number, (place, look) in enumerate(zip(order, looks, strict=True), start=1):
        queue.put(place, f"item {place}")
        while look and (item := queue.take()) is not None:
            out.append(item)
        if look:
            assert queue.due not in order[:number], "the next item is available but was not returned"
        assert len(queue) == number - len(out)
    while (item := queue.take()) is not None:
        out.append(item)
    assert out == [f"item {place}" for place in range(12)]


def open_files(home: Path) -> int:
    files = (file.resolve() for file in Path("/proc/self/fd").iterdir() if file.exists())
    return sum(file.is_relative_to(home) for file in files)


def test_the_workers_of_a_few_leagues_are_kept(tmp_path: Path) -> None:
    document = config().model_dump_json(by_alias=True)
    storages = [Storage.at(tmp_path / str(number)) for number in range(MOST_WORKERS + 1)]
    for storage in storages:
        registered(Registry.open(storage)).close()
    workers = [match_worker(storage, document) for storage in storages[:-1]]
    workers[0]._registry.leagues.get("tictactoe")
    workers[1]._registry.leagues.get("tictactoe")
    assert match_worker(storages[0], document) is workers[0]
    match_worker(storages[-1], document)
    assert match_worker(storages[0], document) is workers[0]
    assert open_files(tmp_path / "0") > 0
    assert open_files(tmp_path / "1") == 0, "the worker that was not used for longest is closed"


@pytest.mark.usefixtures("ray_session")
def test_ray_plays_the_same_matches_with_all_cpus_of_the_cluster(registry: Registry) -> None:
    """Tests have one node with two CPUs."""
    schedule, reports = tournament_schedule(registry), list[Progress]()
    matches = play_schedule(schedule, registry=registry, workers=None, listener=reports.append)
    assert matches == in_ledger(registry) == play_locally(registry, schedule)
    assert (reports[0].nodes, reports[0].cpus) == (None, None), "nothing was played"
    assert (reports[-1].nodes, reports[-1].cpus) == (1, 2)


@pytest.mark.usefixtures("ray_session")
def test_chunks_are_stored_in_order(registry: Registry, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    schedule, reached = tournament_schedule(registry), tmp_path / "reached"

    @ray.remote(num_cpus=1)
    def delay_first_chunk(job: tuple[Schedule, Storage, str, dict[str, str]], chunk: range) -> tuple[str, list[Match]]:
        """The first chunk does not end before the second one."""
        from tests.support.waiting import until

        schedule, storage, config, _ = job
        matches = match_worker(storage, config).play(schedule, chunk)
        if chunk.start == 0:
            until(reached.exists)
        else:
            reached.touch()
        return "node", matches

    monkeypatch.setattr(tournament, "_play_chunk", delay_first_chunk)
    calls: list[list[int]] = []

    def has_second_chunk(matches: list[Match]) -> bool:
        calls.append([match.position for match in matches])
        return False

    assert play_schedule(schedule, registry=registry, workers=2, enough=has_second_chunk) == play_locally(
        registry, schedule
    )
    assert all(positions == list(range(len(positions))) for positions in calls)


@pytest.mark.usefixtures("ray_session")
def test_a_killed_worker_is_replaced(registry: Registry, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    schedule, died = tournament_schedule(registry), tmp_path / "died"

    @ray.remote(num_cpus=1, max_retries=tournament.RETRIES)
    def play_or_die(job: tuple[Schedule, Storage, str, dict[str, str]], chunk: range) -> tuple[str, list[Match]]:
        schedule, storage, config, _ = job
        worker = match_worker(storage, config)
        for position in chunk:
            if chunk.start == 4 and position == 6 and not died.exists():
                died.touch()
                os.kill(os.getpid(), signal.SIGKILL)
            worker.play(schedule, [position])
        return "node", worker.play(schedule, chunk)

    monkeypatch.setattr(tournament, "_play_chunk", play_or_die)
    assert play_schedule(schedule, registry=registry, workers=2) == play_locally(registry, schedule)
    assert died.exists()


@pytest.mark.usefixtures("ray_session")
def test_few_chunks_are_open_at_once(registry: Registry, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """While the first chunk is running, the other worker may play one chunk ahead."""
    schedule, started = tournament_schedule(registry), tmp_path / "started"
    started.mkdir()
    most_open: list[int] = []

    @ray.remote(num_cpus=1)
    def play_and_record(job: tuple[Schedule, Storage, str, dict[str, str]], chunk: range) -> tuple[str, list[Match]]:
        (started / str(chunk.start)).touch()
        schedule, storage, config, _ = job
        return "node", match_worker(storage, config).play(schedule, chunk)

    def count_open_chunks(matches: Sequence[Match]) -> bool:
        most_open.append(sum(int(path.name) >= len(matches) for path in started.iterdir()))
        return False

    monkeypatch.setattr(tournament, "_play_chunk", play_and_record)
    play_schedule(schedule, registry=registry, workers=2, enough=count_open_chunks)
    assert max(most_open) <= 2


@pytest.mark.usefixtures("ray_session")
def test_a_fault_in_a_worker_is_reraised(registry: Registry) -> None:
    (registry.artifacts.root / "tictactoe" / "2" / "shared.onnx").write_bytes(b"tampered")
    with pytest.raises(ArtifactCorrupt, match=r"shared\.onnx"):
        play_schedule(tournament_schedule(registry), registry=registry, workers=2)


KILLED = """
import os, signal, sys
from league.registry.registry import Registry
from league.settings import Storage
from evaluation.documents import Progress
from evaluation.matches.tournament import play_schedule
from tests.support.leagues.tournaments import tournament_schedule

registry = Registry.open(Storage.at(sys.argv[1]))
def listener(progress):
    if progress.played >= 9:
        os.kill(os.getpid(), signal.SIGKILL)
play_schedule(tournament_schedule(registry), registry=registry, workers=int(sys.argv[2]), listener=listener)
"""


@pytest.mark.slow
@pytest.mark.parametrize("workers", [0, 2])
def test_a_killed_tournament_continues(registry: Registry, workers: int) -> None:
    command = [sys.executable, "-c", KILLED, str(registry.storage.home), str(workers)]
    killed = subprocess.run(command, cwd=Path(__file__).parents[3], timeout=120, check=False)
    assert killed.returncode == -signal.SIGKILL
    stored = in_ledger(registry)
    schedule = tournament_schedule(registry)
    expected = play_locally(registry, schedule)
    assert 9 <= len(stored) < schedule.length
    assert stored == expected[: len(stored)]
    assert play_schedule(schedule, registry=registry) == in_ledger(registry) == expected


@pytest.mark.usefixtures("ray_session")
def test_machines_without_a_shared_registry_are_rejected(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    two = [{"Alive": True, "NodeManagerAddress": address} for address in ("192.0.2.1", "192.0.2.2")]
    monkeypatch.setattr(ray, "nodes", lambda: two)
    with pytest.raises(ConfigError, match="the cluster has 2 machines: set LEAGUE_DATABASE_URL"):
        play_schedule(tournament_schedule(registry), registry=registry, workers=2)
    assert in_ledger(registry) == []


def test_evaluation_reports_all_contestants(registry: Registry) -> None:
    report = evaluate(LEAGUE, registry=registry, blocks=20)
    refs = {standing.ref for standing in report.leaderboard}
    assert refs == {"tictactoe@1", "tictactoe@2", "tictactoe@3", "script:random", "script:one_ply"}
    assert report.games == 20 * 2 * 10 == sum(standing.games for standing in report.leaderboard) / 2
    assert 0 < report.unique_games <= report.games
    strongest, *_, weakest = report.leaderboard
    assert (strongest.ref, weakest.ref) == ("tictactoe@3", "tictactoe@1")
    for standing in report.leaderboard:
        assert standing.interval[0] <= standing.rating <= standing.interval[1]
        assert standing.mean_return == pytest.approx(2 * standing.score - 1)
        assert 0 < standing.unique_games <= standing.games
    assert json.loads(json.dumps(report.to_json(), allow_nan=False))["league"] == LEAGUE
    assert sum(share.value for share in report.population.alpha_rank) == pytest.approx(1)
    assert (report.payoff.contestants[0], report.population.nash[-1].value) == (strongest.ref, 0)


def test_a_repeated_evaluation_plays_nothing_and_another_seed_new_games(registry: Registry) -> None:
    registry.aliases.set(LEAGUE, "gold", 2, expected=None, actor="me", reason="test")
    first = evaluate(LEAGUE, ["tictactoe@2"], registry=registry, blocks=5)
    assert {standing.ref for standing in first.leaderboard} == {"tictactoe@2", "script:random", "script:one_ply"}
    matches = in_ledger(registry)
    pinned = ["tictactoe@gold", "tictactoe@2", "script:random"]
    assert evaluate(LEAGUE, pinned, registry=registry, blocks=5) == first
    assert in_ledger(registry) == matches
    other = evaluate(LEAGUE, ["tictactoe@2"], registry=registry, blocks=5, seed=1)
    assert other.schedule != first.schedule
    assert len(in_ledger(registry)) == 2 * len(matches)


def test_contestants_and_options_that_cannot_be_used(registry: Registry, subtests: pytest.Subtests) -> None:
    precise = Budget(precision=5)
    rows: list[tuple[dict[str, Any], type[Exception], str]] = [
        ({"league": "chess", "refs": ["chess@1"]}, UnknownLeague, "chess"),
        ({"refs": ["tictactoe@9"]}, UnknownVersion, "9"),
        ({"refs": ["tictactoe@champion"]}, UnknownAlias, "champion"),
        ({"refs": ["chess@1"]}, EnvironmentMismatch, "chess@1"),
        ({"refs": ["script:clever"]}, UnknownPolicy, "clever"),
        ({"schedule": "swiss"}, InvalidInput, "'swiss'"),
        ({"against": ["tictactoe@1"]}, InvalidInput, "only a gauntlet"),
        ({"schedule": "cross_play", "budget": precise}, InvalidInput, "no ratings"),
        ({"schedule": "cross_play"}, EnvironmentMismatch, r"2 side\(s\)"),
        ({"schedule": "gauntlet", "against": ["tictactoe@1"], "budget": precise}, InvalidInput, "script:random"),
        ({"schedule": "gauntlet", "refs": ["tictactoe@1"], "against": ["tictactoe@1"]}, EnvironmentMismatch, "two"),
    ]
    for options, error, message in rows:
        with subtests.test(options=options), pytest.raises(error, match=message):
            evaluate(**{"league": LEAGUE} | options, registry=registry)
    assert in_ledger(registry) == []


def test_an_adaptive_tournament_is_stored_round_by_round_and_continues_a_shorter_or_killed_one(
    registry: Registry, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each time with a few more matches, stopping within rounds; pairs are chosen only once."""
    report = evaluate(LEAGUE, registry=registry, schedule="adaptive", blocks=12)
    assert (report.kind, report.stopped_by, report.games) == ("adaptive", "schedule", 2 * 30)
    rounds = Ledger(registry).schedules(LEAGUE)
    assert len(rounds) == 6
    assert all(schedule.id.startswith(report.schedule) and schedule.kind == "adaptive" for schedule in rounds)
    assert len({match.seed for match in in_ledger(registry)}) == 30
    assert report.population is None, "some pairs have not played"
    assert all(standing.rating is not None for standing in report.leaderboard)
    assert report.leaderboard[0].ref in {"tictactoe@3", "script:one_ply"}
    with closing(league_at(tmp_path / "other")) as other:
        for games in (6, 16, 30, 44):
            part = evaluate(LEAGUE, registry=other, schedule="adaptive", budget=Budget(games=games))
            assert (part.stopped_by, part.games) == ("games", games)
        assert evaluate(LEAGUE, registry=other, schedule="adaptive", blocks=12) == report
        assert in_ledger(other) == in_ledger(registry)
        monkeypatch.setattr(tournament, "match_worker", None)
        again = evaluate(LEAGUE, registry=other, schedule="adaptive", blocks=12)
        assert again == report, "no match is repeated"


@pytest.mark.usefixtures("ray_session")
@pytest.mark.parametrize("schedule", [pytest.param("adaptive", marks=pytest.mark.slow), "round_robin"])
def test_precision_stops_at_the_same_match_with_workers(registry: Registry, tmp_path: Path, schedule: Any) -> None:
    options: dict[str, Any] = {"schedule": schedule, "budget": Budget(precision=150)}
    report = evaluate(LEAGUE, registry=registry, **options)
    assert report.stopped_by == "precision"
    for standing in report.leaderboard:
        assert standing.interval[1] - standing.interval[0] <= 300
    with closing(league_at(tmp_path / "other", num_envs=5)) as other:
        assert evaluate(LEAGUE, registry=other, workers=2, **options) == report


def test_in_a_gauntlet_the_opponents_do_not_meet(registry: Registry) -> None:
    """By default they are the champion and the scripts."""
    options: dict[str, Any] = {"registry": registry, "schedule": "gauntlet"}
    report = evaluate(LEAGUE, ["tictactoe@3"], against=["tictactoe@1", "script:random"], blocks=4, **options)
    pairs = {("tictactoe@3", "tictactoe@1"), ("tictactoe@3", "script:random")}
    assert {match.contestants for match in in_ledger(registry)} == pairs
    assert (report.games, report.population) == (16, None)
    (schedule,) = Ledger(registry).schedules(LEAGUE)
    assert schedule.kind == "challenge", "nightly runs ignore it"
    promote(registry, 2)
    report = evaluate(LEAGUE, ["tictactoe@3"], blocks=1, **options)
    refs = {"tictactoe@3", "tictactoe@2", "script:random", "script:one_ply"}
    assert {standing.ref for standing in report.leaderboard} == refs


@pytest.fixture
def team(tmp_path: Path) -> Iterator[Registry]:
    """A team of three agents, with two versions."""
    environment = {"entry_point": "mpe2.simple_spread_v3", "kwargs": {"max_cycles": 5}}
    document = {"league": "spread", "environment": environment, "sides": {"team": ["agent_*"]}, "play": {"num_envs": 3}}
    config = LeagueConfig.from_mapping(document)
    with closing(Registry.open(Storage.at(tmp_path / "team"))) as opened:
        opened.leagues.register(config, interface(config))
        spaces = opened.leagues.get("spread").interface.of_policy("shared")
        for seed in (1, 2):
            tictactoe.publish(opened, tictactoe.linear(spaces, seed), "spread")
        yield opened


def test_cross_play_mixes_versions_in_a_team(team: Registry) -> None:
    report = evaluate("spread", registry=team, schedule="cross_play", blocks=6)
    (schedule,), matches = Ledger(team).schedules("spread"), in_ledger(team, "spread")
    assert schedule.sides == ("agent_0", "agent_1", "agent_2")
    mixed = ("spread@1", "spread@2")
    assert {match.contestants for match in matches} == {("spread@1", "spread@1"), mixed, ("spread@2", "spread@2")}
    seats = {game.sides for match in matches for game in match.games}
    assert seats == {(0, 1, 1), (1, 0, 1), (1, 1, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)}
    table = report.cross_play
    assert (report.leaderboard, report.payoff.score, report.scoring) == ((), (), "team")
    assert table.contestants == mixed
    for cell in (cell for row in table.returns for cell in row):
        assert cell.low < cell.value < (cell.high or 0) < 0
    games = [match.games[0] for match in matches if match.contestants == mixed]
    seat, teammates = zip(*(game.returns for game in games), strict=True)
    assert table.returns[0][1].value == pytest.approx((np.mean(seat) + 2 * np.mean(teammates)) / 3)
    assert compute_leaderboard(team, "spread") == (), "team games have no leaderboard"
    first, second = next(match for match in matches if match.contestants == mixed).games
    assert first.actions != second.actions, "teammates affect the game"


def test_each_cross_play_game_can_be_replayed(team: Registry) -> None:
    evaluate("spread", registry=team, schedule="cross_play", blocks=3)
    environment = stock_stepping(team.leagues.get("spread").config.environment, 1)
    matches = in_ledger(team, "spread")
    for match in matches:
        for index, game in enumerate(match.games):
            source = recorded_game(match.id, index, team)
            assert list(source.controllers.values()) == [match.contestants[side] for side in game.sides]
            assert len(list(source.play(environment))) == 5 + 1
    assert play_locally(team, Ledger(team).schedule(matches[0].schedule)) == matches


ROLES = {"adversary": ["adversary_*"], "good": ["agent_*"]}


@pytest.fixture
def empty(tmp_path: Path) -> Iterator[Registry]:
    with closing(Registry.open(Storage.at(tmp_path / "empty"))) as opened:
        yield opened


def register(registry: Registry, entry_point: str, **parts: Any) -> tuple[LeagueConfig, AgentInterface]:
    """A league of this environment, without two equal sides, and the spaces of its first policy."""
    document = {"league": "kind", "environment": {"entry_point": entry_point, "kwargs": {"max_cycles": 12}}}
    config = LeagueConfig.from_mapping(document | {"gate": {"elo1": 100, "max_blocks": 200}} | parts)
    registry.leagues.register(config, described := interface(config))
    return config, described.of_policy(described.policy_ids[0])


def test_solo_contestants_are_compared_on_common_seeds(empty: Registry) -> None:
    _, spaces = register(empty, "mpe2.simple_v3")
    for graph in (tictactoe.linear(spaces, 3), tictactoe.chase_landmark(spaces), tictactoe.chase_landmark(spaces)):
        tictactoe.publish(empty, graph, "kind")
    report = evaluate("kind", registry=empty, blocks=12)
    leaderboard = {standing.ref: standing for standing in report.leaderboard}
    assert (report.scoring, report.by_side, report.games) == ("side", {}, 6 * 12 * 2)
    assert {standing.games for standing in leaderboard.values()} == {3 * 12}
    assert all(0 < (s.unique_games or 0) <= s.games for s in leaderboard.values())
    best, twin, random = (report.payoff.contestants.index(ref) for ref in ("kind@2", "kind@3", "script:random"))
    assert report.payoff.score[best][twin] == pytest.approx(0.5)
    assert report.payoff.score[best][random] == pytest.approx(1.0)
    level, better = report.payoff.difference[best][twin], report.payoff.difference[best][random]
    assert (level.mean, level.low, level.high) == (0, 0, 0)
    assert better.low > 0
    gain = leaderboard["kind@2"].mean_return - leaderboard["script:random"].mean_return
    assert better.mean == pytest.approx(gain, rel=0.5)


def test_different_sides_are_rated_separately_and_together(empty: Registry) -> None:
    register(empty, "mpe2.simple_adversary_v3", sides=ROLES, policies=ROLES)
    report = evaluate("kind", ["script:random", "script:random", "script:first"], registry=empty, blocks=30)
    assert report.scoring == "side"
    assert set(report.by_side) == {"adversary", "good"}
    for leaderboard in report.by_side.values():
        assert {standing.ref: standing.rating for standing in leaderboard}["script:random"] == 0
        assert {standing.games for standing in leaderboard} == {30}
        assert sum(standing.score for standing in leaderboard) == pytest.approx(1)
    for standing in report.leaderboard:
        parts = [side.score for sides in report.by_side.values() for side in sides if side.ref == standing.ref]
        assert sum(parts) / 2 == pytest.approx(standing.score)
    first, _ = report.payoff.contestants
    assert report.payoff.by_side["good"][0][1] == next(s.score for s in report.by_side["good"] if s.ref == first)


def test_a_free_for_all_is_rated(empty: Registry) -> None:
    config, spaces = register(empty, "mpe2.simple_spread_v3")
    tictactoe.publish(empty, tictactoe.linear(spaces, 1), "kind")
    report = nightly(config, registry=empty)
    assert report.faults == ()
    assert {standing.ref for standing in report.leaderboard} == {"kind@1", "script:random"}
    assert all(standing.rating is not None for standing in report.leaderboard)


LIMIT = 60.0
"""Seconds that a game may take."""


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> None:
    """Environments take no time until they hang, and then too much at once."""
    times = [0.0]
    fail = Fuse._fail

    def hang(environment: Fuse) -> None:
        times.append(times[-1] + 2 * LIMIT)
        fail(environment)

    monkeypatch.setattr(watchdog, "LEAST_OFTEN", watchdog.MOST_OFTEN)
    monkeypatch.setattr(Fuse, "_fail", hang)
    for module in (copies, lockstep):
        monkeypatch.setattr(module, "perf_counter", lambda: times[-1])


VECTOR = "tests.support.environments.vector_copies:VectorFuse"


def fuse_league(ends: str, where: str = "step", seconds: float = LIMIT, vector: str | None = None) -> LeagueConfig:
    entry_point, kwargs = "tests.support.environments.fuses:fuse", {"ends": ends, "where": where}
    return LeagueConfig.from_mapping(
        {
            "league": "fuse",
            "environment": {"entry_point": entry_point, "kwargs": kwargs, "vector": vector},
            # Its versions take their most likely action, as a sampled one would let the fuse go out.
            "play": {"num_envs": 3, "game_seconds": seconds, "actions": "greedy"},
            "gate": {"elo1": 100, "max_blocks": 4},
        }
    )


def league(home: Path, settings: LeagueConfig, *actions: int) -> Registry:
    """A league with a version for each of `actions`, which always takes this action."""
    registry = Registry.open(Storage.at(home))
    registry.leagues.register(settings, interface(settings))
    spaces = registry.leagues.get("fuse").interface.of_policy("shared")
    for action in actions:
        weights = np.zeros((2, ACTIONS))
        weights[:, action] = 1
        tictactoe.publish(registry, tictactoe.linear(spaces, chosen=weights), "fuse")
    return registry


def schedule_of(registry: Registry, *refs: str) -> Schedule:
    row = registry.leagues.get("fuse")
    return round_robin(row.config, row.interface, refs, 4)


@pytest.mark.usefixtures("clock")
@pytest.mark.parametrize("where", ["step", "reset"])
@pytest.mark.parametrize("ends", ["waits", "spins", "swallows"])
def test_a_hanging_environment_is_interrupted_and_replaced(tmp_path: Path, ends: str, where: str) -> None:
    settings = fuse_league(ends, where)
    registry = league(tmp_path, settings, 1, LIGHT, 2)
    worker, handler_before = MatchWorker(settings, registry), signal.getsignal(watchdog.TICK)
    with pytest.raises(GameHung, match=r"of fuse@1 and fuse@2 \(game [01] of match fuse-.*/[0-3]\) .* 60 s"):
        worker.play(schedule_of(registry, "fuse@1", "fuse@2"), range(4))
    assert len(worker.play(schedule_of(registry, "fuse@1", "fuse@3"), range(4))) == 4
    assert signal.getsignal(watchdog.TICK) == handler_before


@pytest.mark.usefixtures("clock")
def test_the_hanging_game_is_reported_and_not_the_oldest(tmp_path: Path) -> None:
    """The game at position 0 started first, but another one hangs."""
    settings = fuse_league("waits")
    registry = league(tmp_path, settings, 1, 2, LIGHT)
    schedule = schedule_of(registry, "fuse@1", "fuse@2", "fuse@3")
    hanging = next(p for p in range(schedule.length) if "fuse@3" in schedule.contestants_at(p))
    assert hanging > 0
    with pytest.raises(GameHung, match=rf"match {schedule.match_id(hanging)}\)"):
        MatchWorker(settings, registry).play(schedule, range(schedule.length))


@pytest.mark.parametrize(
    ("vector", "message"),
    [
        (None, "of fuse@[12] and fuse@3 .* raised"),
        (VECTOR, r"of fuse@. and fuse@. \(game . of match .*\), or one of \d+ others that are stepped .* raised"),
    ],
)
def test_a_crash_of_the_environment_names_the_game(tmp_path: Path, vector: str | None, message: str) -> None:
    settings = fuse_league("breaks", vector=vector)
    registry = league(tmp_path, settings, 1, 2, LIGHT)
    worker, schedule = MatchWorker(settings, registry), schedule_of(registry, "fuse@1", "fuse@2", "fuse@3")
    with pytest.raises(GameCrashed, match=f"{message} ValueError: the fuse has burnt down"):
        worker.play(schedule, range(schedule.length))
    assert len(worker.play(schedule_of(registry, "fuse@1", "fuse@2"), range(4))) == 4


@pytest.mark.usefixtures("clock")
def test_a_hanging_vectorised_environment_is_interrupted(tmp_path: Path) -> None:
    settings = fuse_league("waits", vector=VECTOR)
    registry = league(tmp_path, settings, 1, LIGHT)
    schedule = schedule_of(registry, "fuse@1", "fuse@2")
    with pytest.raises(GameHung, match="or one of 2 others that are stepped with it, has not ended after 60 s"):
        MatchWorker(settings, registry).play(schedule, range(4))


def test_slow_steps_add_up_in_any_thread(tmp_path: Path) -> None:
    """No single step is too long; in threads without signals, the deadline is checked after each step."""
    settings = fuse_league("breaks")
    registry = league(tmp_path, settings, 1, 2)
    schedule, raised = schedule_of(registry, "fuse@1", "fuse@2"), []
    environment = stock_stepping(settings.environment, 2)
    player = MatchWorker(settings, registry)
    roster = {ref: player.contestant(ref) for ref in schedule.contestants}

    def slow() -> None:
        try:
            play_matches(schedule, [0], environment, player.interface, roster, deadline=Deadline(1e-6))
        except LeagueError as error:
            raised.append(error)

    thread = threading.Thread(target=slow)
    thread.start()
    thread.join()
    assert [type(error) for error in raised] == [GameHung]


def test_only_the_time_of_its_environment_counts_for_a_game(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With a clock that advances by one at each reading, a reset or a step takes 1 s and a game 5 s, whatever other
    games run.
    """
    clock = itertools.count()
    monkeypatch.setattr(copies, "perf_counter", lambda: float(next(clock)))
    for seconds, is_enough in ((3.5, False), (20.0, True)):
        settings = fuse_league("breaks", seconds=seconds)
        registry = league(tmp_path / str(seconds), settings, 1, 2)
        player, schedule = MatchWorker(settings, registry), schedule_of(registry, "fuse@1", "fuse@2")
        if is_enough:
            assert len(player.play(schedule, range(4))) == 4
        else:
            with pytest.raises(GameHung, match=r"after 3\.5 s"):
                player.play(schedule, range(4))


@pytest.mark.usefixtures("clock")
def test_a_nightly_run_continues_with_a_version_whose_games_hang(tmp_path: Path) -> None:
    settings = fuse_league("waits")
    registry = league(tmp_path, settings, 1, LIGHT, 2)
    report = nightly(settings, registry=registry)
    assert [verdict.candidate for verdict in report.verdicts] == ["fuse@1", "fuse@3"]
    assert any("fuse@2" in fault and "has not ended" in fault for fault in report.faults)
    refs = {standing.ref for standing in report.leaderboard}
    assert {"fuse@1", "fuse@3", ANCHOR} <= refs


@pytest.mark.usefixtures("ray_session")
def test_a_hanging_game_in_a_worker_is_reported(tmp_path: Path) -> None:
    registry = league(tmp_path, fuse_league("spins", seconds=1.0), 1, LIGHT, 2)
    with pytest.raises(GameHung, match="of fuse@1 and fuse@2"):
        play_schedule(schedule_of(registry, "fuse@1", "fuse@2"), registry=registry, workers=2)
    schedule = schedule_of(registry, "fuse@1", "fuse@3")
    assert play_schedule(schedule, registry=registry, workers=2) == Ledger(registry).matches(league="fuse")
