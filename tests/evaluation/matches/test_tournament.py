import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest
import ray
from hypothesis import given, settings
from hypothesis import strategies as st

from evaluation.documents import Progress
from evaluation.matches import tournament
from evaluation.matches.tournament import chunks_of, evaluate, play_schedule
from evaluation.matches.worker import match_worker
from league.errors import (
    ArtifactCorrupt,
    ConfigError,
    EnvironmentMismatch,
    UnknownAlias,
    UnknownLeague,
    UnknownPolicy,
    UnknownVersion,
)
from league.registry.registry import Registry
from league.results.ledger import Ledger
from league.results.records import Match, Schedule
from league.settings import Storage
from tests.support.leagues import tictactoe
from tests.support.leagues.tournaments import STRENGTHS, tournament_schedule


@pytest.fixture
def registry(tmp_path: Path) -> Iterator[Registry]:
    """Tic-tac-toe with three versions of increasing strength."""
    opened = tictactoe.registry(tmp_path / "home", play={"opening_plies": 2, "num_envs": 2})
    for strength in STRENGTHS:
        tictactoe.publish(opened, tictactoe.graph(**strength))
    yield opened
    opened.close()


def in_ledger(registry: Registry) -> list[Match]:
    return Ledger(registry).matches(league=tictactoe.LEAGUE)


def play_locally(registry: Registry, schedule: Schedule) -> list[Match]:
    """The matches of a single process, without the ledger."""
    config = registry.leagues.get(tictactoe.LEAGUE).config.model_dump_json(by_alias=True)
    return match_worker(registry.storage, config).play(schedule, range(schedule.length))


def test_matches_are_stored_in_order(registry: Registry) -> None:
    schedule = tournament_schedule(registry)
    matches = play_schedule(schedule, registry=registry)
    assert matches == in_ledger(registry) == play_locally(registry, schedule)


def test_stored_matches_are_not_played_again(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    schedule = tournament_schedule(registry)
    matches = play_schedule(schedule, registry=registry)
    monkeypatch.setattr(tournament, "match_worker", None)
    assert play_schedule(schedule, registry=registry) == matches


def test_it_stops_when_enough_is_true(registry: Registry) -> None:
    schedule = tournament_schedule(registry)
    matches = play_schedule(schedule, registry=registry, enough=lambda matches: len(matches) >= 10)
    assert len(matches) == 12
    assert play_schedule(schedule, registry=registry) == play_locally(registry, schedule)


def test_progress_is_reported(registry: Registry) -> None:
    events: list[Progress] = []
    schedule = tournament_schedule(registry)
    play_schedule(schedule, registry=registry, listener=events.append)
    reports = [event for event in events if isinstance(event, Progress)]
    assert [report.played for report in reports] == [0, 1, 2, *range(4, schedule.length, 4), schedule.length]
    assert reports[0].moves_per_second is None
    assert all(report.moves_per_second > 0 for report in reports[1:])


def test_a_schedule_of_another_environment_is_rejected(registry: Registry) -> None:
    schedule = tournament_schedule(registry)
    Ledger(registry).open(schedule)
    row = registry.leagues.get(tictactoe.LEAGUE)
    environment = {**row.config.environment.model_dump(), "kwargs": {"screen_height": 500}}
    registry.leagues.register(tictactoe.config(environment=environment), row.interface)
    with pytest.raises(EnvironmentMismatch, match="another game than league tictactoe has now"):
        play_schedule(schedule, registry=registry)


def test_a_schedule_of_other_openings_is_rejected(registry: Registry) -> None:
    schedule = tournament_schedule(registry)
    Ledger(registry).open(schedule)
    row = registry.leagues.get(tictactoe.LEAGUE)
    registry.leagues.register(tictactoe.config(play={"opening_plies": 5}), row.interface)
    with pytest.raises(EnvironmentMismatch, match="another game than league tictactoe has now"):
        play_schedule(schedule, registry=registry)


@settings(deadline=None)
@given(st.integers(0, 60), st.integers(1, 60), st.integers(1, 40))
def test_chunks_cover_the_missing_matches_and_keep_their_bounds(played: int, length: int, num_envs: int) -> None:
    """Bounds do not depend on the matches that were already played, nor on the length of the schedule."""
    chunks = chunks_of(length, played, num_envs)
    assert [position for chunk in chunks for position in chunk] == list(range(played, length))
    bounds = {chunk.stop for chunk in chunks_of(1000, 0, num_envs)}
    assert all(chunk.stop in bounds or chunk.stop == length for chunk in chunks)


@pytest.mark.parametrize(
    ("num_envs", "bounds"), [(2, [1, 2, 4, 8, 12, 16]), (3, [2, 4, 8, 14, 20]), (512, [256, 512, 1024, 2048, 3072])]
)
def test_a_chunk_is_as_long_as_all_earlier_ones_within_limits(num_envs: int, bounds: list[int]) -> None:
    assert [chunk.stop for chunk in chunks_of(bounds[-1], 0, num_envs)] == bounds


@pytest.mark.slow
@pytest.mark.usefixtures("ray_session")
def test_ray_plays_the_same_matches(registry: Registry) -> None:
    schedule = tournament_schedule(registry)
    assert (
        play_schedule(schedule, registry=registry, workers=2) == in_ledger(registry) == play_locally(registry, schedule)
    )


@pytest.mark.usefixtures("ray_session")
def test_without_a_number_of_workers_all_cpus_of_the_cluster_play(registry: Registry) -> None:
    """Tests have one node with two CPUs."""
    events: list[Progress] = []
    schedule = tournament_schedule(registry)
    play_schedule(schedule, registry=registry, workers=None, listener=events.append)
    reports = [event for event in events if isinstance(event, Progress)]
    assert (reports[0].nodes, reports[0].cpus) == (None, None), "nothing was played"
    assert (reports[-1].nodes, reports[-1].cpus) == (1, 2)


@pytest.mark.usefixtures("ray_session")
def test_chunks_that_finish_out_of_order_are_stored_in_order(
    registry: Registry, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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
    seen: list[list[int]] = []

    def has_second_chunk(matches: list[Match]) -> bool:
        seen.append([match.position for match in matches])
        return False

    assert play_schedule(schedule, registry=registry, workers=2, enough=has_second_chunk) == play_locally(
        registry, schedule
    )
    assert all(positions == list(range(len(positions))) for positions in seen)


@pytest.mark.usefixtures("ray_session")
def test_a_worker_killed_during_a_chunk_is_replaced(
    registry: Registry, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    schedule, died = tournament_schedule(registry), tmp_path / "died"

    @ray.remote(num_cpus=1, max_retries=tournament.RETRIES)
    def play_or_die(job: tuple[Schedule, Storage, str, dict[str, str]], chunk: range) -> tuple[str, list[Match]]:
        schedule, storage, config, _ = job
        here = match_worker(storage, config)
        for position in chunk:
            if chunk.start == 4 and position == 6 and not died.exists():
                died.touch()
                os.kill(os.getpid(), signal.SIGKILL)
            here.play(schedule, [position])
        return "node", here.play(schedule, chunk)

    monkeypatch.setattr(tournament, "_play_chunk", play_or_die)
    assert play_schedule(schedule, registry=registry, workers=2) == play_locally(registry, schedule)
    assert died.exists()


@pytest.mark.usefixtures("ray_session")
def test_the_number_of_open_chunks_is_limited(
    registry: Registry, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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


NODES = """
import sys
import ray
from ray.cluster_utils import Cluster
from league.registry.registry import Registry
from league.settings import Storage
from evaluation.matches.tournament import play_schedule
from tests.support.leagues.tournaments import tournament_schedule

cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
nodes = [cluster.add_node(num_cpus=1) for _ in range(2)]
ray.init(address=cluster.address, log_to_driver=False, logging_level="ERROR")

def listener(progress):
    if nodes and progress.played >= 9:
        cluster.remove_node(nodes.pop(), allow_graceful=False)
        nodes.clear()
        cluster.add_node(num_cpus=1)
registry = Registry.open(Storage.at(sys.argv[1]))
play_schedule(tournament_schedule(registry), registry=registry, workers=2, listener=listener)
assert not nodes
ray.shutdown()
cluster.shutdown()
"""


@pytest.mark.slow
def test_a_killed_node_loses_no_match(registry: Registry) -> None:
    """Three Ray nodes on this machine with shared files, in a subprocess, as this process has its own Ray."""
    command = [sys.executable, "-c", NODES, str(registry.storage.home)]
    process = subprocess.run(command, cwd=Path(__file__).parents[3], timeout=200, check=False, capture_output=True)
    assert process.returncode == 0, process.stderr.decode()
    assert in_ledger(registry) == play_locally(registry, tournament_schedule(registry))


@pytest.mark.usefixtures("ray_session")
def test_machines_without_a_shared_registry_are_rejected(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    two = [{"Alive": True, "NodeManagerAddress": address} for address in ("192.0.2.1", "192.0.2.2")]
    monkeypatch.setattr(ray, "nodes", lambda: two)
    with pytest.raises(ConfigError, match="the cluster has 2 machines: set LEAGUE_DATABASE_URL"):
        play_schedule(tournament_schedule(registry), registry=registry, workers=2)
    assert in_ledger(registry) == []


def test_evaluation_reports_all_contestants(registry: Registry) -> None:
    report = evaluate(tictactoe.LEAGUE, registry=registry, blocks=20)
    refs = {standing.ref for standing in report.leaderboard}
    assert refs == {"tictactoe@1", "tictactoe@2", "tictactoe@3", "script:random", "script:one_ply"}
    assert report.games == 20 * 2 * 10 == sum(standing.games for standing in report.leaderboard) / 2
    assert 0 < report.unique_games <= report.games
    strongest, *_, weakest = report.leaderboard
    assert (strongest.ref, weakest.ref) == ("tictactoe@3", "tictactoe@1")
    for standing in report.leaderboard:
        assert standing.rating is not None
        assert standing.interval is not None
        assert standing.interval[0] <= standing.rating <= standing.interval[1]
        assert standing.mean_return == pytest.approx(2 * standing.score - 1)
        assert standing.unique_games is not None
        assert 0 < standing.unique_games <= standing.games
    assert json.loads(json.dumps(report.to_json(), allow_nan=False))["league"] == tictactoe.LEAGUE


def test_a_repeated_evaluation_plays_nothing_and_another_seed_new_games(registry: Registry) -> None:
    first = evaluate(tictactoe.LEAGUE, ["tictactoe@2"], registry=registry, blocks=5)
    matches = in_ledger(registry)
    assert evaluate(tictactoe.LEAGUE, ["tictactoe@2"], registry=registry, blocks=5) == first
    assert in_ledger(registry) == matches
    other = evaluate(tictactoe.LEAGUE, ["tictactoe@2"], registry=registry, blocks=5, seed=1)
    assert other.schedule != first.schedule
    assert len(in_ledger(registry)) == 2 * len(matches)


def test_evaluation_pins_aliases(registry: Registry) -> None:
    registry.aliases.set(tictactoe.LEAGUE, "champion", 2, expected=None, actor="me", reason="test")
    report = evaluate(
        tictactoe.LEAGUE, ["tictactoe@champion", "tictactoe@2", "script:random"], registry=registry, blocks=2
    )
    assert {s.ref for s in report.leaderboard} == {"tictactoe@2", "script:random", "script:one_ply"}


@pytest.mark.parametrize(
    ("league", "ref", "error"),
    [
        ("chess", "chess@1", UnknownLeague),
        ("tictactoe", "tictactoe@9", UnknownVersion),
        ("tictactoe", "tictactoe@champion", UnknownAlias),
        ("tictactoe", "chess@1", EnvironmentMismatch),
        ("tictactoe", "script:clever", UnknownPolicy),
    ],
)
def test_contestants_that_cannot_take_part_are_rejected(
    registry: Registry, league: str, ref: str, error: type[Exception]
) -> None:
    with pytest.raises(error):
        evaluate(league, [ref], registry=registry)
    assert in_ledger(registry) == []
