"""Signals that end a command, and a terminal that is closed."""

import os
import pty
import signal
import subprocess
import sys
import threading

import pytest

from league import interruption
from league.interruption import ending_signals, exit_code, hangup_blocked, on_ending_signals


def test_a_hangup_ends_a_command_unless_it_is_ignored() -> None:
    assert signal.SIGHUP in ending_signals()
    former = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        assert ending_signals() == (signal.SIGINT, signal.SIGTERM)
        with on_ending_signals(lambda: None):
            assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, former)


def test_the_last_signal_decides_the_exit_code(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(interruption, "_last_signal", signal.SIGINT)
    former, codes = signal.getsignal(signal.SIGTERM), list[int]()
    with on_ending_signals(lambda: codes.append(exit_code())):
        for number in (signal.SIGHUP, signal.SIGINT, signal.SIGTERM):
            signal.raise_signal(number)
    assert codes == [129, 130, 143]
    assert signal.getsignal(signal.SIGTERM) is former


def test_another_thread_handles_no_signals() -> None:
    former, handlers = signal.getsignal(signal.SIGTERM), list[object]()

    def work() -> None:
        with on_ending_signals(lambda: None):
            handlers.append(signal.getsignal(signal.SIGTERM))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert handlers == [former]


CLOSED = """
import os
from league.interruption import on_ending_signals
reader, writer = os.pipe()
with on_ending_signals(lambda: os.write(writer, b"x")):
    print("ready", flush=True)
    os.read(reader, 1)
    print("to nobody", flush=True)
os.write(WRITER, b"handled")
"""


def test_output_to_a_closed_terminal_does_not_fail() -> None:
    terminal, end = pty.openpty()
    result, writer = os.pipe()
    program = CLOSED.replace("WRITER", str(writer))
    with subprocess.Popen(
        [sys.executable, "-c", program], stdin=end, stdout=end, stderr=end, pass_fds=[writer], start_new_session=True
    ) as process:
        os.close(end)
        os.close(writer)
        assert os.read(terminal, 100).startswith(b"ready")
        os.close(terminal)
        process.send_signal(signal.SIGHUP)
    assert (process.returncode, os.read(result, 100)) == (0, b"handled")
    os.close(result)


def test_processes_that_a_command_works_with_survive_a_hangup() -> None:
    program = "import signal; signal.raise_signal(signal.SIGHUP); print('alive')"
    with hangup_blocked():
        done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == "alive\n"
    assert signal.SIGHUP not in signal.pthread_sigmask(signal.SIG_BLOCK, ())
