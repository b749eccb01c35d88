"""Runs of ONNX graphs that end: one thread of the process ends those that take too long.

A run cannot be interrupted inside of an operator; between operators, and between the steps of a loop, ONNX Runtime
checks a flag. The thread that sets it counts its own turns instead of reading a clock: a process that was stopped, or
got no processor time, ends no run because of that.
"""

from threading import Lock, Thread
from time import sleep
from typing import Any

import onnxruntime
from numpy.typing import NDArray

from league.errors import GraphTimeout

TURN = 0.05
"""Seconds between two turns of the thread."""


class _Run:
    """A run, in progress or to be reused: options are expensive to create."""

    __slots__ = ("first_turn", "limit", "options")

    first_turn: int
    """The turn in which it began."""
    limit: float
    """Turns after which it is ended."""

    def __init__(self) -> None:
        self.options = onnxruntime.RunOptions()


_runs: set[_Run] = set()
"""In progress."""
_idle: list[_Run] = []
"""Only runs that nobody is about to end."""
_turn = 0
_lock = Lock()
_watching: Thread | None = None


def open_session(graph: bytes) -> Any:
    """Open a graph, on one thread. Raises what ONNX Runtime raises."""
    global _watching
    with _lock:
        if _watching is None or not _watching.is_alive():  # a forked process has no threads
            _runs.clear()
            _watching = Thread(target=_watch, name="graph-runs", daemon=True)
            _watching.start()
    options = onnxruntime.SessionOptions()
    # Replicas and workers are processes; more threads would compete with them for cores.
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    options.log_severity_level = 4
    return onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])


def run_graph(session: Any, outputs: list[str], feed: dict[str, NDArray], seconds: float) -> Any:
    """Return the outputs of a session from `open_session`.

    Raises:
        GraphTimeout: It did not finish within `seconds`.
        Exception: What ONNX Runtime raises.
    """
    try:
        run = _idle.pop()
    except IndexError:
        run = _Run()
    run.first_turn, run.limit = _turn, 1 + seconds / TURN
    _runs.add(run)
    try:
        return session.run(outputs, feed, run.options)
    except Exception:
        if run.options.terminate:
            raise GraphTimeout(f"a run of the graph did not finish within {seconds:g} s") from None
        raise
    finally:
        _runs.discard(run)
        if _turn + 1 - run.first_turn < run.limit:
            _idle.append(run)


def _watch() -> None:
    global _turn
    while True:
        sleep(TURN)
        _turn += 1
        for run in tuple(_runs):
            if _turn - run.first_turn >= run.limit:
                run.options.terminate = True
