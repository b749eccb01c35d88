"""Games that do not end, or end in an exception of their environment, are told by name, and the night goes on."""

from __future__ import annotations

import itertools
import signal
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from evaluation.contestants import ANCHOR
from evaluation.deadline import Deadline, Expired, watched
from evaluation.nightly import nightly
from evaluation.play import play
from evaluation.player import Player
from evaluation.schedule import round_robin
from evaluation.tournament import run
from league.config import LeagueConfig
from league.environments.building import interface
from league.environments.lockstep import stepping
from league.errors import GameCrashed, GameHung, LeagueError
from league.registry.registry import Registry
from league.results.ledger import Ledger
from league.results.records import Schedule
from league.settings import Storage
from tests.evaluation import examples
from tests.evaluation.fuses import ACTIONS, LIGHT, fuse

SOON = 1.0
"""Seconds: a game takes a thousandth of it, where nothing hangs."""


def config(ends: str, where: str = "step", seconds: float = SOON) -> LeagueConfig:
    return LeagueConfig.from_mapping(
        {
            "league": "fuse",
            "environment": {"entry_point": "tests.evaluation.fuses:fuse", "kwargs": {"ends": ends, "where": where}},
            "play": {"copies": 3, "game_seconds": seconds},
            "gate": {"elo1": 100, "max_blocks": 4},
        }
    )


def league(home: Path, settings: LeagueConfig, *actions: int) -> Registry:
    """A league with a version for each of `actions`, which takes that one always."""
    registry = Registry.open(Storage.at(home))
    registry.register(settings, interface(settings))
    spaces = registry.league("fuse").interface.of_policy("shared")
    for action in actions:
        chosen = np.zeros((2, ACTIONS))
        chosen[:, action] = 1
        examples.publish(registry, examples.linear(spaces, chosen=chosen), "fuse")
    return registry


def meeting(registry: Registry, *refs: str) -> Schedule:
    row = registry.league("fuse")
    return round_robin(row.config, row.interface, refs, 4)


@pytest.mark.parametrize("where", ["step", "reset"])
@pytest.mark.parametrize("ends", ["waits", "spins", "swallows"])
def test_an_environment_that_hangs_is_interrupted(tmp_path: Path, ends: str, where: str) -> None:
    settings = config(ends, where)
    registry = league(tmp_path, settings, 1, LIGHT, 2)
    player = Player(settings, registry)
    before = signal.getsignal(signal.SIGALRM)
    with pytest.raises(GameHung, match=r"of fuse@1 and fuse@2 \(game [01] of match fuse-.*/[0-3]\) .* 1 s"):
        player.play(meeting(registry, "fuse@1", "fuse@2"), range(4))
    quiet = meeting(registry, "fuse@1", "fuse@3")
    assert len(player.play(quiet, range(4))) == 4, "what was interrupted is not used again"
    assert signal.getsignal(signal.SIGALRM) == before


def test_a_hang_that_is_another_games_is_not_told_of_the_oldest(tmp_path: Path) -> None:
    """Position 0 began first on its copy and is innocent; the one that lights the fuse is named."""
    settings = config("waits")
    registry = league(tmp_path, settings, 1, 2, LIGHT)
    schedule = meeting(registry, "fuse@1", "fuse@2", "fuse@3")
    guilty = next(p for p in range(schedule.length) if "fuse@3" in schedule.contestants_at(p))
    assert guilty > 0
    with pytest.raises(GameHung, match=rf"match {schedule.match_id(guilty)}\)"):
        Player(settings, registry).play(schedule, range(schedule.length))


def test_a_crash_of_the_environment_names_the_game(tmp_path: Path) -> None:
    settings = config("breaks")
    registry = league(tmp_path, settings, 1, LIGHT, 2)
    player = Player(settings, registry)
    with pytest.raises(GameCrashed, match=r"of fuse@1 and fuse@2 .* raised ValueError: the fuse has burnt down"):
        player.play(meeting(registry, "fuse@1", "fuse@2"), range(4))
    assert len(player.play(meeting(registry, "fuse@1", "fuse@3"), range(4))) == 4


def test_slow_steps_add_up_in_any_thread(tmp_path: Path) -> None:
    """No single step is too long, and where there is no signal, steps that have ended are looked at all the same."""
    settings = config("breaks")
    registry = league(tmp_path, settings, 1, 2)
    schedule, raised = meeting(registry, "fuse@1", "fuse@2"), []
    environment = stepping(settings.environment, 2)
    player = Player(settings, registry)
    roster = {ref: player.contestant(ref) for ref in schedule.contestants}

    def slow() -> None:
        try:
            play(schedule, [0], environment, player.interface, roster, deadline=Deadline(1e-6))
        except LeagueError as error:
            raised.append(error)

    thread = threading.Thread(target=slow)
    thread.start()
    thread.join(30)
    assert [type(error) for error in raised] == [GameHung]


def test_a_game_is_charged_for_its_own_environment_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By a clock that goes on by one at each look, a reset or a step takes 1 s and a game 5 s, whatever its company."""
    clock = itertools.count()
    monkeypatch.setattr("league.environments.lockstep.perf_counter", lambda: float(next(clock)))
    for seconds, is_enough in ((3.5, False), (20.0, True)):
        settings = config("breaks", seconds=seconds)
        registry = league(tmp_path / str(seconds), settings, 1, 2)
        player, schedule = Player(settings, registry), meeting(registry, "fuse@1", "fuse@2")
        if is_enough:
            assert len(player.play(schedule, range(4))) == 4
        else:
            with pytest.raises(GameHung, match=r"after 3\.5 s"):
                player.play(schedule, range(4))


def test_a_night_goes_on_beside_a_version_that_hangs_a_game(tmp_path: Path) -> None:
    settings = config("waits")
    registry = league(tmp_path, settings, 1, LIGHT, 2)
    report = nightly(settings, registry=registry)
    assert [verdict.candidate for verdict in report.verdicts] == ["fuse@1", "fuse@3"]
    assert any("fuse@2" in fault and "has not ended" in fault for fault in report.faults)
    refs = {standing.ref for standing in report.standings}
    assert {"fuse@1", "fuse@3", ANCHOR} <= refs


@pytest.mark.usefixtures("ray_session")
def test_a_worker_tells_it_too(tmp_path: Path) -> None:
    registry = league(tmp_path, config("spins"), 1, LIGHT, 2)
    with pytest.raises(GameHung, match="of fuse@1 and fuse@2"):
        run(meeting(registry, "fuse@1", "fuse@2"), registry=registry, workers=2)
    schedule = meeting(registry, "fuse@1", "fuse@3")
    assert run(schedule, registry=registry, workers=2) == Ledger(registry).matches(league="fuse")


STALLED = """
import sys
from evaluation import deadline
from tests.evaluation.fuses import BURNING

deadline.GRACE = 0.2
with deadline.watched(lambda: None, deadline.Deadline(0.2, expendable=True)):
    BURNING[sys.argv[1]]()
"""


def test_an_expendable_process_ends_where_no_signal_is_minded() -> None:
    command = [sys.executable, "-c", STALLED, "stalls"]
    done = subprocess.run(
        command, cwd=Path(__file__).parents[2], timeout=60, check=False, capture_output=True, text=True
    )
    assert done.returncode == 1
    assert "in stalls" in done.stderr


def test_the_timer_of_before_goes_on() -> None:
    """pytest's own deadline may be one."""
    rung: list[int] = []
    handler = signal.signal(signal.SIGALRM, lambda *_: rung.append(1))
    rest = signal.setitimer(signal.ITIMER_REAL, 60)
    try:
        with watched(lambda: None, Deadline(10)):
            assert signal.getitimer(signal.ITIMER_REAL)[1] == 1.0
        left, interval = signal.getitimer(signal.ITIMER_REAL)
        assert (interval, rung) == (0, [])
        assert 50 < left <= 60
    finally:
        signal.setitimer(signal.ITIMER_REAL, *rest)
        signal.signal(signal.SIGALRM, handler)


def test_what_is_raised_by_a_look_comes_out() -> None:
    def look() -> None:
        raise Expired(GameHung("too long"))

    with pytest.raises(Expired, match="too long"), watched(look, Deadline(0.05)):
        fuse("waits")._burn()
