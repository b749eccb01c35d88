"""Games that do not end, or raise, are reported by name, and the nightly run continues."""

from __future__ import annotations

import itertools
import signal
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from evaluation.gating.nightly import nightly
from evaluation.matches import watchdog
from evaluation.matches.game_loop import play_matches
from evaluation.matches.tournament import play_schedule
from evaluation.matches.watchdog import Deadline, GameTimeout, enforce_deadline
from evaluation.matches.worker import MatchWorker
from evaluation.schedules.builders import ANCHOR, round_robin
from league.config.league import LeagueConfig
from league.environments import lockstep, vector_stepping
from league.environments.building import interface
from league.environments.lockstep import stock_stepping
from league.errors import GameCrashed, GameHung, LeagueError
from league.registry.registry import Registry
from league.results.ledger import Ledger
from league.results.records import Schedule
from league.settings import Storage
from tests.support.environments.fuses import ACTIONS, LIGHT, Fuse, fuse
from tests.support.leagues import tictactoe

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
    for module in (lockstep, vector_stepping):
        monkeypatch.setattr(module, "perf_counter", lambda: times[-1])


def config(ends: str, where: str = "step", seconds: float = LIMIT, vector: str | None = None) -> LeagueConfig:
    return LeagueConfig.from_mapping(
        {
            "league": "fuse",
            "environment": {
                "entry_point": "tests.support.environments.fuses:fuse",
                "kwargs": {"ends": ends, "where": where},
                "vector": vector,
            },
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
        chosen = np.zeros((2, ACTIONS))
        chosen[:, action] = 1
        tictactoe.publish(registry, tictactoe.linear(spaces, chosen=chosen), "fuse")
    return registry


def schedule_of(registry: Registry, *refs: str) -> Schedule:
    row = registry.leagues.get("fuse")
    return round_robin(row.config, row.interface, refs, 4)


@pytest.mark.usefixtures("clock")
@pytest.mark.parametrize("where", ["step", "reset"])
@pytest.mark.parametrize("ends", ["waits", "spins", "swallows"])
def test_a_hanging_environment_is_interrupted(tmp_path: Path, ends: str, where: str) -> None:
    settings = config(ends, where)
    registry = league(tmp_path, settings, 1, LIGHT, 2)
    worker = MatchWorker(settings, registry)
    handler_before = signal.getsignal(signal.SIGALRM)
    with pytest.raises(GameHung, match=r"of fuse@1 and fuse@2 \(game [01] of match fuse-.*/[0-3]\) .* 60 s"):
        worker.play(schedule_of(registry, "fuse@1", "fuse@2"), range(4))
    quiet = schedule_of(registry, "fuse@1", "fuse@3")
    assert len(worker.play(quiet, range(4))) == 4, "the interrupted environment is replaced"
    assert signal.getsignal(signal.SIGALRM) == handler_before


@pytest.mark.usefixtures("clock")
def test_the_hanging_game_is_reported_and_not_the_oldest(tmp_path: Path) -> None:
    """The game at position 0 started first, but another one hangs."""
    settings = config("waits")
    registry = league(tmp_path, settings, 1, 2, LIGHT)
    schedule = schedule_of(registry, "fuse@1", "fuse@2", "fuse@3")
    hanging = next(p for p in range(schedule.length) if "fuse@3" in schedule.contestants_at(p))
    assert hanging > 0
    with pytest.raises(GameHung, match=rf"match {schedule.match_id(hanging)}\)"):
        MatchWorker(settings, registry).play(schedule, range(schedule.length))


def test_a_crash_of_the_environment_names_the_game(tmp_path: Path) -> None:
    settings = config("breaks")
    registry = league(tmp_path, settings, 1, LIGHT, 2)
    worker = MatchWorker(settings, registry)
    with pytest.raises(GameCrashed, match=r"of fuse@1 and fuse@2 .* raised ValueError: the fuse has burnt down"):
        worker.play(schedule_of(registry, "fuse@1", "fuse@2"), range(4))
    assert len(worker.play(schedule_of(registry, "fuse@1", "fuse@3"), range(4))) == 4


VECTOR = "tests.support.environments.vector_copies:VectorFuse"


def test_a_crash_in_a_vectorised_environment_names_the_game(tmp_path: Path) -> None:
    settings = config("breaks", vector=VECTOR)
    registry = league(tmp_path, settings, 1, 2, LIGHT)
    worker = MatchWorker(settings, registry)
    schedule = schedule_of(registry, "fuse@1", "fuse@2", "fuse@3")
    message = (
        r"of fuse@. and fuse@3 \(game 0 of match .*\) cannot continue: .* raised ValueError: the fuse has burnt down"
    )
    with pytest.raises(GameCrashed, match=message):
        worker.play(schedule, range(schedule.length))
    assert len(worker.play(schedule_of(registry, "fuse@1", "fuse@2"), range(4))) == 4


@pytest.mark.usefixtures("clock")
def test_a_hanging_vectorised_environment_is_interrupted(tmp_path: Path) -> None:
    settings = config("waits", vector=VECTOR)
    registry = league(tmp_path, settings, 1, LIGHT)
    schedule = schedule_of(registry, "fuse@1", "fuse@2")
    with pytest.raises(GameHung, match="or one of 2 others that are stepped with it, has not ended after 60 s"):
        MatchWorker(settings, registry).play(schedule, range(4))


def test_slow_steps_add_up_in_any_thread(tmp_path: Path) -> None:
    """No single step is too long; in threads without signals, the deadline is checked after each step."""
    settings = config("breaks")
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


def test_only_the_time_of_its_own_environment_counts_for_a_game(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a clock that advances by one at each reading, a reset or a step takes 1 s and a game 5 s, whatever other
    games run.
    """
    clock = itertools.count()
    monkeypatch.setattr(lockstep, "perf_counter", lambda: float(next(clock)))
    for seconds, is_enough in ((3.5, False), (20.0, True)):
        settings = config("breaks", seconds=seconds)
        registry = league(tmp_path / str(seconds), settings, 1, 2)
        player, schedule = MatchWorker(settings, registry), schedule_of(registry, "fuse@1", "fuse@2")
        if is_enough:
            assert len(player.play(schedule, range(4))) == 4
        else:
            with pytest.raises(GameHung, match=r"after 3\.5 s"):
                player.play(schedule, range(4))


@pytest.mark.usefixtures("clock")
def test_a_nightly_run_continues_with_a_version_whose_games_hang(tmp_path: Path) -> None:
    settings = config("waits")
    registry = league(tmp_path, settings, 1, LIGHT, 2)
    report = nightly(settings, registry=registry)
    assert [verdict.candidate for verdict in report.verdicts] == ["fuse@1", "fuse@3"]
    assert any("fuse@2" in fault and "has not ended" in fault for fault in report.faults)
    refs = {standing.ref for standing in report.leaderboard}
    assert {"fuse@1", "fuse@3", ANCHOR} <= refs


@pytest.mark.usefixtures("ray_session")
def test_a_hanging_game_in_a_worker_is_reported(tmp_path: Path) -> None:
    registry = league(tmp_path, config("spins", seconds=1.0), 1, LIGHT, 2)
    with pytest.raises(GameHung, match="of fuse@1 and fuse@2"):
        play_schedule(schedule_of(registry, "fuse@1", "fuse@2"), registry=registry, workers=2)
    schedule = schedule_of(registry, "fuse@1", "fuse@3")
    assert play_schedule(schedule, registry=registry, workers=2) == Ledger(registry).matches(league="fuse")


STALLED = """
import sys
from evaluation.matches import watchdog
from tests.support.environments.fuses import FAULTS

watchdog.GRACE = 0.2
with watchdog.enforce_deadline(lambda: None, watchdog.Deadline(0.2, expendable=True)):
    FAULTS[sys.argv[1]]()
"""


def test_an_expendable_process_exits_if_signals_are_ignored() -> None:
    command = [sys.executable, "-c", STALLED, "stalls"]
    process = subprocess.run(
        command, cwd=Path(__file__).parents[3], timeout=240, check=False, capture_output=True, text=True
    )
    assert process.returncode == 1
    assert "in stalls" in process.stderr


def test_an_existing_timer_is_restored() -> None:
    """Such as the timeout of pytest."""
    alarms: list[int] = []
    handler = signal.signal(signal.SIGALRM, lambda *_: alarms.append(1))
    previous = signal.setitimer(signal.ITIMER_REAL, 600)
    try:
        with enforce_deadline(lambda: None, Deadline(10)):
            assert signal.getitimer(signal.ITIMER_REAL)[1] == 1.0
        left, interval = signal.getitimer(signal.ITIMER_REAL)
        assert (interval, alarms) == (0, [])
        assert 300 < left <= 600
    finally:
        signal.setitimer(signal.ITIMER_REAL, *previous)
        signal.signal(signal.SIGALRM, handler)


def test_an_exception_of_the_check_is_raised() -> None:
    def check() -> None:
        raise GameTimeout(GameHung("too long"))

    with pytest.raises(GameTimeout, match="too long"), enforce_deadline(check, Deadline(0.05)):
        fuse("waits")._fail()
