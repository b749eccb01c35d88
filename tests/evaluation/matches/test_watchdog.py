"""Deadlines for games: which signals they use, and environments that hang when they are closed."""

import signal
import subprocess
import sys
from pathlib import Path
from threading import Event

import numpy as np
import pytest

from evaluation.matches import watchdog
from evaluation.matches.watchdog import TICK, Deadline, GameTimeout, close_in_time, enforce_deadline
from league.environments.copies import StockCopies
from league.environments.lockstep import Lockstep
from league.errors import GameHung
from tests.support.environments.engines import RUNNING, engine
from tests.support.waiting import until

STALLED = """
import sys
from evaluation.matches import watchdog
from tests.support.environments.fuses import FAULTS

watchdog.GRACE = 0.2
with watchdog.enforce_deadline(lambda: None, watchdog.Deadline(0.2, expendable=True)):
    FAULTS[sys.argv[1]]()
"""


def expire() -> None:
    raise GameTimeout(GameHung("too long"))


def test_an_expendable_process_exits_if_signals_are_ignored() -> None:
    command = [sys.executable, "-c", STALLED, "stalls"]
    process = subprocess.run(
        command, cwd=Path(__file__).parents[3], timeout=240, check=False, capture_output=True, text=True
    )
    assert process.returncode == 1
    assert "in stalls" in process.stderr


def test_an_exception_of_the_check_is_raised() -> None:
    with pytest.raises(GameTimeout, match="too long"), enforce_deadline(expire, Deadline(0.05)):
        Event().wait(60)


def test_an_environment_may_use_the_timer_of_the_process() -> None:
    """As decorators for time limits do, which stop the timer in the end."""
    alarms: list[int] = []
    handler, previous = signal.signal(signal.SIGALRM, lambda *_: alarms.append(1)), signal.getitimer(signal.ITIMER_REAL)

    def check() -> None:
        if alarms:
            expire()

    def play() -> None:
        signal.setitimer(signal.ITIMER_REAL, 0.01)
        until(lambda: alarms)
        signal.setitimer(signal.ITIMER_REAL, 0)
        Event().wait(60)

    try:
        with pytest.raises(GameTimeout), enforce_deadline(check, Deadline(0.05)):
            play()
    finally:
        signal.signal(signal.SIGALRM, handler)
        signal.setitimer(signal.ITIMER_REAL, *previous)
    assert alarms == [1]


def test_a_block_within_another_one_keeps_its_deadline() -> None:
    handler, outer, inner = signal.getsignal(TICK), [], []
    with enforce_deadline(lambda: outer.append(1), Deadline(0.05)):
        with enforce_deadline(lambda: inner.append(1), Deadline(0.05)):
            until(lambda: outer and inner)
        outer.clear()
        until(lambda: outer)
    assert signal.getsignal(TICK) == handler
    count = len(outer), len(inner)
    signal.raise_signal(TICK)  # one that arrives late changes nothing
    assert (len(outer), len(inner)) == count


def test_an_environment_that_hangs_in_close_is_given_up(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(watchdog, "CLOSE_SECONDS", 0.05)
    environments = iter([engine(closes="hangs"), engine(), engine()])
    stepping = Lockstep(StockCopies(lambda: next(environments), 3))
    stepping.copies.busy = np.array([0])  # it was interrupted
    close_in_time(stepping)
    assert RUNNING == []
    assert [record.message for record in caplog.records] == ["the environment's close has not ended after 0.05 s"]
