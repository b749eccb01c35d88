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

from evaluation import tournament
from evaluation.player import player
from evaluation.report import Progress, VerdictReport
from evaluation.schedule import round_robin
from evaluation.tournament import chunks_of, evaluate, run
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
from tests.evaluation import examples

STRENGTHS = ({}, {"wins": True}, {"wins": True, "blocks": True, "order": examples.CENTRE_FIRST})


@pytest.fixture
def registry(tmp_path: Path) -> Iterator[Registry]:
    """Tic-tac-toe with three versions, each stronger than the one before."""
    opened = examples.registry(tmp_path / "home", play={"opening_plies": 2, "copies": 2})
    for strength in STRENGTHS:
        examples.publish(opened, examples.graph(**strength))
    yield opened
    opened.close()


def a_schedule(registry: Registry, blocks: int = 6) -> Schedule:
    row = registry.league(examples.LEAGUE)
    contestants = ["tictactoe@1", "tictactoe@2", "tictactoe@3", "script:random"]
    return round_robin(row.config, row.interface, contestants, blocks)


def in_ledger(registry: Registry) -> list[Match]:
    return Ledger(registry).matches(league=examples.LEAGUE)


def undisturbed(registry: Registry, schedule: Schedule) -> list[Match]:
    """What a single process plays, without the ledger."""
    config = registry.league(examples.LEAGUE).config.model_dump_json(by_alias=True)
    return player(registry.storage, config).play(schedule, range(schedule.length))


def test_matches_are_in_the_ledger_in_order(registry: Registry) -> None:
    schedule = a_schedule(registry)
    matches = run(schedule, registry=registry)
    assert matches == in_ledger(registry) == undisturbed(registry, schedule)


def test_what_is_in_the_ledger_is_not_played_again(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    schedule = a_schedule(registry)
    matches = run(schedule, registry=registry)
    monkeypatch.setattr(tournament, "player", None)
    assert run(schedule, registry=registry) == matches


def test_it_ends_when_there_is_enough(registry: Registry) -> None:
    schedule = a_schedule(registry)
    matches = run(schedule, registry=registry, enough=lambda so_far: len(so_far) >= 10)
    assert len(matches) == 12
    assert run(schedule, registry=registry) == undisturbed(registry, schedule)


def test_progress_is_told(registry: Registry) -> None:
    told: list[Progress | VerdictReport] = []
    schedule = a_schedule(registry)
    run(schedule, registry=registry, listener=told.append)
    played = [progress.played for progress in told if isinstance(progress, Progress)]
    assert played == [*range(0, schedule.length, 4), schedule.length]


def test_a_schedule_of_another_environment_is_refused(registry: Registry) -> None:
    schedule = a_schedule(registry)
    Ledger(registry).open(schedule)
    row = registry.league(examples.LEAGUE)
    environment = {**row.config.environment.model_dump(), "kwargs": {"screen_height": 500}}
    registry.register(examples.config(environment=environment), row.interface)
    with pytest.raises(EnvironmentMismatch, match="another environment"):
        run(schedule, registry=registry)


@settings(deadline=None)
@given(st.integers(0, 60), st.integers(1, 60), st.integers(1, 40))
def test_chunks_are_aligned_and_cover_what_is_missing(played: int, length: int, copies: int) -> None:
    chunks = chunks_of(length, played, copies)
    assert [position for chunk in chunks for position in chunk] == list(range(played, length))
    size = tournament.GAMES_PER_COPY * copies // 2
    assert {position // size for chunk in chunks for position in chunk[:1]} == {c.start // size for c in chunks}
    assert all(len(chunk) <= size and (chunk.stop % size == 0 or chunk.stop == length) for chunk in chunks)


@pytest.mark.usefixtures("ray_session")
def test_ray_plays_the_same(registry: Registry) -> None:
    schedule = a_schedule(registry)
    assert run(schedule, registry=registry, workers=2) == in_ledger(registry) == undisturbed(registry, schedule)


@pytest.mark.usefixtures("ray_session")
def test_chunks_that_finish_out_of_order_wait_for_their_turn(
    registry: Registry, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    schedule, reached = a_schedule(registry), tmp_path / "reached"

    @ray.remote(num_cpus=1)
    def last_comes_first(job: tuple[Schedule, Storage, str], chunk: range) -> list[Match]:
        """The first chunk does not end before the second has."""
        from tests.evaluation.waiting import until

        schedule, storage, config = job
        matches = player(storage, config).play(schedule, chunk)
        if chunk.start == 0:
            until(reached.exists)
        else:
            reached.touch()
        return matches

    monkeypatch.setattr(tournament, "_play_chunk", last_comes_first)
    seen: list[list[int]] = []

    def watch(matches: list[Match]) -> bool:
        seen.append([match.position for match in matches])
        return False

    assert run(schedule, registry=registry, workers=2, enough=watch) == undisturbed(registry, schedule)
    assert all(positions == list(range(len(positions))) for positions in seen)


@pytest.mark.usefixtures("ray_session")
def test_a_worker_that_is_killed_in_the_middle_of_a_chunk_is_replaced(
    registry: Registry, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    schedule, died = a_schedule(registry), tmp_path / "died"

    @ray.remote(num_cpus=1, max_retries=tournament.RETRIES)
    def mortal(job: tuple[Schedule, Storage, str], chunk: range) -> list[Match]:
        schedule, storage, config = job
        here = player(storage, config)
        for position in chunk:
            if chunk.start == 4 and position == 6 and not died.exists():
                died.touch()
                os.kill(os.getpid(), signal.SIGKILL)
            here.play(schedule, [position])
        return here.play(schedule, chunk)

    monkeypatch.setattr(tournament, "_play_chunk", mortal)
    assert run(schedule, registry=registry, workers=2) == undisturbed(registry, schedule)
    assert died.exists()


@pytest.mark.usefixtures("ray_session")
def test_no_more_chunks_are_open_than_workers(
    registry: Registry, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """While the first chunk is not done, the other worker may play one chunk, and waits with what it could play."""
    schedule, begun = a_schedule(registry), tmp_path / "begun"
    begun.mkdir()
    most_open: list[int] = []

    @ray.remote(num_cpus=1)
    def noted(job: tuple[Schedule, Storage, str], chunk: range) -> list[Match]:
        (begun / str(chunk.start)).touch()
        schedule, storage, config = job
        return player(storage, config).play(schedule, chunk)

    def watch(matches: Sequence[Match]) -> bool:
        most_open.append(sum(int(path.name) >= len(matches) for path in begun.iterdir()))
        return False

    monkeypatch.setattr(tournament, "_play_chunk", noted)
    run(schedule, registry=registry, workers=2, enough=watch)
    assert max(most_open) <= 2


@pytest.mark.usefixtures("ray_session")
def test_a_fault_in_a_worker_is_the_fault_itself(registry: Registry) -> None:
    (registry.artifacts.root / "tictactoe" / "2" / "shared.onnx").write_bytes(b"tampered")
    with pytest.raises(ArtifactCorrupt, match=r"shared\.onnx"):
        run(a_schedule(registry), registry=registry, workers=2)


KILLED = """
import os, signal, sys
from league.registry.registry import Registry
from league.settings import Storage
from evaluation.report import Progress
from evaluation.tournament import run
from tests.evaluation.test_tournament import a_schedule

registry = Registry.open(Storage.at(sys.argv[1]))
def listener(progress):
    if progress.played >= 9:
        os.kill(os.getpid(), signal.SIGKILL)
run(a_schedule(registry), registry=registry, workers=int(sys.argv[2]), listener=listener)
"""


@pytest.mark.parametrize("workers", [0, 2])
def test_a_tournament_that_was_killed_goes_on(registry: Registry, workers: int) -> None:
    command = [sys.executable, "-c", KILLED, str(registry.storage.home), str(workers)]
    killed = subprocess.run(command, cwd=Path(__file__).parents[2], timeout=120, check=False)
    assert killed.returncode == -signal.SIGKILL
    left = in_ledger(registry)
    schedule = a_schedule(registry)
    expected = undisturbed(registry, schedule)
    assert 9 <= len(left) < schedule.length
    assert left == expected[: len(left)]
    assert run(schedule, registry=registry) == in_ledger(registry) == expected


NODES = """
import sys
import ray
from ray.cluster_utils import Cluster
from league.registry.registry import Registry
from league.settings import Storage
from evaluation.tournament import run
from tests.evaluation.test_tournament import a_schedule

cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
nodes = [cluster.add_node(num_cpus=1) for _ in range(2)]
ray.init(address=cluster.address, log_to_driver=False, logging_level="ERROR")

def listener(progress):
    if nodes and progress.played >= 9:
        cluster.remove_node(nodes.pop(), allow_graceful=False)
        nodes.clear()
        cluster.add_node(num_cpus=1)
registry = Registry.open(Storage.at(sys.argv[1]))
run(a_schedule(registry), registry=registry, workers=2, listener=listener)
assert not nodes
ray.shutdown()
cluster.shutdown()
"""


def test_a_node_that_is_killed_takes_no_match_with_it(registry: Registry) -> None:
    """Three nodes of Ray on this machine, which share its files. Kept out of this process, whose Ray is another one."""
    command = [sys.executable, "-c", NODES, str(registry.storage.home)]
    played = subprocess.run(command, cwd=Path(__file__).parents[2], timeout=200, check=False, capture_output=True)
    assert played.returncode == 0, played.stderr.decode()
    assert in_ledger(registry) == undisturbed(registry, a_schedule(registry))


@pytest.mark.usefixtures("ray_session")
def test_machines_that_do_not_share_the_registry_are_refused(
    registry: Registry, monkeypatch: pytest.MonkeyPatch
) -> None:
    two = [{"Alive": True, "NodeManagerAddress": address} for address in ("192.0.2.1", "192.0.2.2")]
    monkeypatch.setattr(ray, "nodes", lambda: two)
    with pytest.raises(ConfigError, match="the cluster has 2 machines: set LEAGUE_DATABASE_URL"):
        run(a_schedule(registry), registry=registry, workers=2)
    assert in_ledger(registry) == []


def test_evaluation_reports_everybody(registry: Registry) -> None:
    report = evaluate(examples.LEAGUE, registry=registry, blocks=20)
    refs = {standing.ref for standing in report.standings}
    assert refs == {"tictactoe@1", "tictactoe@2", "tictactoe@3", "script:random", "script:one_ply"}
    assert report.games == 20 * 2 * 10 == sum(standing.games for standing in report.standings) / 2
    assert 0 < report.distinct_games <= report.games
    strongest, *_, weakest = report.standings
    assert (strongest.ref, weakest.ref) == ("tictactoe@3", "tictactoe@1")
    for standing in report.standings:
        assert standing.rating is not None
        assert standing.interval is not None
        assert standing.interval[0] <= standing.rating <= standing.interval[1]
        assert standing.mean_return == pytest.approx(2 * standing.score - 1)
        assert standing.distinct_games is not None
        assert 0 < standing.distinct_games <= standing.games
    assert json.loads(json.dumps(report.to_json(), allow_nan=False))["league"] == examples.LEAGUE


def test_evaluation_again_plays_nothing_and_another_seed_other_games(registry: Registry) -> None:
    first = evaluate(examples.LEAGUE, ["tictactoe@2"], registry=registry, blocks=5)
    matches = in_ledger(registry)
    assert evaluate(examples.LEAGUE, ["tictactoe@2"], registry=registry, blocks=5) == first
    assert in_ledger(registry) == matches
    other = evaluate(examples.LEAGUE, ["tictactoe@2"], registry=registry, blocks=5, seed=1)
    assert other.schedule != first.schedule
    assert len(in_ledger(registry)) == 2 * len(matches)


def test_evaluation_pins_aliases(registry: Registry) -> None:
    registry.set_alias(examples.LEAGUE, "champion", 2, expected=None, actor="me", reason="test")
    report = evaluate(
        examples.LEAGUE, ["tictactoe@champion", "tictactoe@2", "script:random"], registry=registry, blocks=2
    )
    assert {s.ref for s in report.standings} == {"tictactoe@2", "script:random", "script:one_ply"}


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
def test_contestants_that_cannot_take_part_are_refused(
    registry: Registry, league: str, ref: str, error: type[Exception]
) -> None:
    with pytest.raises(error):
        evaluate(league, [ref], registry=registry)
    assert in_ledger(registry) == []
