"""Ray Tune as training uses it: quiet, in this directory, and ended by Ctrl-C as a person expects."""

import logging
import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ray import tune

from training.interrupts import first_asks
from training.tensorboard import TensorBoard

QUIET = {
    "RAY_CHDIR_TO_TRIAL_DIR": "0",  # a trial stays here, where a user's own environment is importable
    "RAY_AIR_NEW_OUTPUT": "0",
    "TUNE_PRINT_ALL_TRIAL_ERRORS": "0",
    "TUNE_DISABLE_SIGINT_HANDLER": "1",  # it ends trials without a checkpoint
    "TUNE_DISABLE_STRICT_METRIC_CHECKING": "1",  # before an episode is over there is no return
}


class Unpickled:
    """Tune pickles what it is given, for a way of resuming that is not ours: nothing of the driver goes into it."""

    def __getstate__(self) -> dict[str, Any]:
        return {}


def quiet() -> None:
    """The progress is ours: none of Tune's tables, hints and traces, nor RLlib's deprecations of its own calls."""
    os.environ.update(QUIET)
    logging.getLogger("ray._common.deprecation").setLevel(logging.ERROR)
    logging.getLogger("ray.tune").setLevel(logging.CRITICAL)


def run_config(path: Path, callbacks: list[tune.Callback], stop: tune.Stopper) -> tune.RunConfig:
    """An experiment in the directory `path`, with curves for TensorBoard. Its checkpoints are no matter of Tune's."""
    return tune.RunConfig(
        name=path.name,
        storage_path=str(path.parent),
        callbacks=[*callbacks, TensorBoard()],
        stop=stop,
        checkpoint_config=tune.CheckpointConfig(checkpoint_at_end=False),
        verbose=0,
    )


def fit(tuner: tune.Tuner, ask_to_end: Callable[[], None]) -> tune.ResultGrid:
    """Run the experiment to its end. The first Ctrl-C calls `ask_to_end`; a second one raises KeyboardInterrupt."""
    with _usr1_as_before(), first_asks(ask_to_end):
        return tuner.fit()


@contextmanager
def _usr1_as_before() -> Iterator[None]:
    """Tune leaves its own handler behind."""
    before = signal.getsignal(signal.SIGUSR1)
    try:
        yield
    finally:
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGUSR1, before)
