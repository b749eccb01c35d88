"""Python subprocesses that end with their parent: start, deadline, stop and reap; requests and responses over pipes."""

from __future__ import annotations

import json
import os
import queue
import signal
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from types import MappingProxyType
from typing import IO, Any

from league.errors import LeagueError, WorkerLost, from_document, to_document

POLL_INTERVAL = 0.1
"""Seconds between two checks whether a subprocess has exited."""
END_TIMEOUT = 15.0
"""Seconds after which a subprocess that answers requests ends without its cleanup."""


class Subprocess:
    """A running `python -m MODULE ARGUMENT` with the import path of this process.

    Its standard input is a pipe that closes when this process ends, however that happens. The subprocess detects that
    with `exit_with_parent` or `when_parent_ends`, or by reading its input to the end. It runs in a session of its own,
    so that Ctrl-C reaches the parent only.
    """

    def __init__(
        self,
        module: str,
        argument: str = "",
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
    def deadline(self, seconds: float | None) -> Iterator[None]:
        """Kill it if the block takes longer than `seconds`, if given. Reads from its pipes then return."""
        if seconds is None:
            yield
            return
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


class RequestProcess:
    """A subprocess that answers requests, see `answer_requests`.

    It starts with the first request, and again with the next one after it has died. One request at a time; another
    thread may call `close`.
    """

    def __init__(
        self,
        module: str,
        argument: str = "",
        environment: Mapping[str, str] = MappingProxyType({}),
        *,
        work: str,
        start_timeout: float | None = None,
    ) -> None:
        """Describe it; see `Subprocess`.

        Args:
            module: The module.
            argument: Its argument.
            environment: Environment variables besides those of this process.
            work: What it does, for messages: `plays games`.
            start_timeout: Seconds within which it must be ready; None for no limit.
        """
        self._command = module, argument, environment
        self._work, self._start_timeout = work, start_timeout
        self._process: Subprocess | None = None
        self._is_closed = False
        self._lock = threading.Lock()

    @property
    def pid(self) -> int | None:
        """Its process id; None before it starts, and after it has died in a request."""
        process = self._process
        return None if process is None else process.pid

    def request(self, line: str, timeout: float | None = None) -> tuple[dict[str, Any], bytes]:
        """Send a request and return its response: a document and further bytes.

        Args:
            line: The request, without line breaks.
            timeout: Seconds until the process is killed; None for no limit.

        Raises:
            LeagueError: The error that the process reports.
            TimeoutError: The process was killed after `timeout`.
            WorkerLost: It died or was closed.
            OSError: It cannot be started.
        """
        with self._lock:
            if self._is_closed:
                raise WorkerLost(f"the process that {self._work} was ended")
            is_new = self._process is None
            process = self._process = self._process or Subprocess(*self._command, output=True)
        began = time.monotonic()
        try:
            if is_new:
                with process.deadline(self._start_timeout):
                    json.loads(process.stdout.readline())
                began = time.monotonic()
            with process.deadline(timeout):
                process.stdin.write(line.encode() + b"\n")
                process.stdin.flush()
                head: dict[str, Any] = json.loads(process.stdout.readline())
                content = process.stdout.read(head["size"])
            if len(content) < head["size"]:
                raise ValueError("the response is truncated")
        except (OSError, ValueError) as error:
            self._stop()
            if timeout is not None and time.monotonic() - began >= timeout:
                raise TimeoutError from error
            raise WorkerLost(f"the process that {self._work} died: see its messages") from error
        if "code" in head:
            raise from_document(head)
        return head, content

    def close(self) -> None:
        """End it, also during a request. It may clean up for END_TIMEOUT seconds."""
        with self._lock:
            self._is_closed = True
            process, self._process = self._process, None
        if process is not None:
            process.terminate(END_TIMEOUT)

    def _stop(self) -> None:
        with self._lock:
            process, self._process = self._process, None
        if process is not None:
            process.stop()


class _EndOfRequests(BaseException):
    """The parent has ended, or has no further requests. Not an Exception, which a response may catch."""


def answer_requests(
    respond: Callable[[bytes], tuple[Mapping[str, Any], bytes]], cleanup: Callable[[], None] = lambda: None
) -> None:
    """Answer the requests of a `RequestProcess` in this subprocess until the parent ends, also during a response.

    It writes `{}` when it is ready. Each line of standard input is a request. Responses follow in order: a JSON object
    in a line, with `size`, and so many bytes.

    respond: returns the object and the bytes. A LeagueError is a response, too; other exceptions are bugs, which end
    the process. cleanup: called at the end. If it does not return within END_TIMEOUT seconds, the process ends.
    """
    requests: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    main = threading.get_ident()

    def end(*_: object) -> None:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)  # nothing interrupts the cleanup
        raise _EndOfRequests

    def read() -> None:
        for line in sys.stdin.buffer:
            requests.put(line)
        signal.pthread_kill(main, signal.SIGTERM)
        time.sleep(END_TIMEOUT)
        os._exit(0)

    signal.signal(signal.SIGTERM, end)
    responses = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # output of environments must not mix with responses
    threading.Thread(target=read, name="requests", daemon=True).start()
    head: Mapping[str, Any] = {}
    content, code = b"", 0
    try:
        try:
            while True:
                responses.write(json.dumps(head).encode() + b"\n" + content)
                responses.flush()
                try:
                    head, content = respond(requests.get())
                except LeagueError as error:
                    head, content = to_document(error), b""
                head = {**head, "size": len(content)}
        except _EndOfRequests:
            pass
        except BaseException:
            traceback.print_exc()
            code = 1
        cleanup()
    finally:
        os._exit(code)  # an exit would wait for the lock of standard input, which the other thread holds


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
