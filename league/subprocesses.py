"""Python subprocesses that end with their parent: start, wait, deadline, stop and reap."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from types import MappingProxyType
from typing import IO

POLL_INTERVAL = 0.1
"""Seconds between two checks whether a subprocess has exited."""


class Subprocess:
    """A running `python -m MODULE ARGUMENT` with the import path of this process.

    Its standard input is a pipe that closes when this process ends, however that happens. The subprocess detects that
    with `exit_with_parent` or `when_parent_ends`, or by reading its input to the end. It runs in a session of its own,
    so that Ctrl-C reaches the parent only.
    """

    def __init__(
        self,
        module: str,
        argument: str,
        environment: Mapping[str, str] = MappingProxyType({}),
        *,
        output: bool = False,
        errors: IO[bytes] | None = None,
    ) -> None:
        """Start it.

        Args:
            module: The module.
            argument: Its argument, which all users of the machine can see: no secrets.
            environment: Environment variables besides those of this process.
            output: Connect standard output to a pipe.
            errors: File for standard error; None for that of this process.
        """
        paths = os.pathsep.join(path for path in sys.path if path)
        self._process = subprocess.Popen(
            [sys.executable, "-m", module, argument],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE if output else None,
            stderr=errors,
            env=os.environ | environment | {"PYTHONPATH": paths},
            start_new_session=True,
        )

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    @property
    def is_running(self) -> bool:
        """Whether it has not exited yet."""
        return self._process.poll() is None

    @property
    def stdin(self) -> IO[bytes]:
        """Pipe to its standard input."""
        assert self._process.stdin is not None
        return self._process.stdin

    @property
    def stdout(self) -> IO[bytes]:
        """Pipe from its standard output. Requires `output`."""
        assert self._process.stdout is not None
        return self._process.stdout

    def wait(self, stop: threading.Event) -> None:
        """Wait until it exits or `stop` is set."""
        while self.is_running and not stop.wait(POLL_INTERVAL):
            pass

    @contextmanager
    def deadline(self, seconds: float) -> Iterator[None]:
        """Kill it if the block takes longer than `seconds`. Reads from its pipes then return."""
        timer = threading.Timer(seconds, self.kill)
        timer.start()
        try:
            yield
        finally:
            timer.cancel()

    def kill(self) -> None:
        """Send SIGKILL. Does nothing if it has exited."""
        self._process.kill()

    def terminate(self, timeout: float) -> int:
        """Send SIGTERM, kill it if it has not exited after `timeout` seconds, and reap it. Returns its exit code."""
        self._process.terminate()
        with self.deadline(timeout):
            return self.reap()

    def stop(self) -> int:
        """Kill and reap it. Returns its exit code, which is 0 if it had exited normally before."""
        self.kill()
        return self.reap()

    def reap(self) -> int:
        """Wait for its exit, close the pipes and return the exit code."""
        code = self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                with suppress(BrokenPipeError):  # input that it did not read
                    pipe.close()
        return code


def exit_with_parent(cleanup: Callable[[], None] = lambda: None) -> None:
    """Exit this subprocess with code 1 when its parent ends, after calling `cleanup` in a background thread."""

    def end() -> None:
        try:
            cleanup()
        finally:
            os._exit(1)

    when_parent_ends(end)


def when_parent_ends(action: Callable[[], None]) -> None:
    """Call `action` in a background thread when the parent of this subprocess ends."""

    def watch() -> None:
        # Not `sys.stdin`: the interpreter aborts if it exits while a thread holds the lock of a buffer.
        while os.read(0, 1024):
            pass
        action()

    threading.Thread(target=watch, name="parent-watch", daemon=True).start()


BACKGROUND = 19
"""Niceness of work that nobody waits for."""
INTERACTIVE = 5
"""Niceness of work that a person waits for: above background work, below serving replicas."""


def lower_priority(niceness: int = BACKGROUND) -> None:
    """Lower the CPU priority of this process."""
    os.nice(niceness)
