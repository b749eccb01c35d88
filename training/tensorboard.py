"""The curves of a trial for TensorBoard, grouped by policy and by what they are about, over the actions of training."""

from math import isfinite
from typing import Any

from ray.tune.experiment import Trial
from ray.tune.logger.tensorboardx import TBXLoggerCallback

WHOLE = "run"
"""The group of the curves that belong to no policy."""
NOT_CURVES = {"timesteps_total", "timesteps_since_restore", "training_iteration", "iterations_since_restore"} | {
    "time_this_iter_s", "time_total_s", "time_since_restore", "timestamp", "pid",
}  # fmt: skip


class TensorBoard(TBXLoggerCallback):
    """Takes the place of Tune's logger, which puts everything into one group, its own bookkeeping included, and writes
    to where a person finds it only now and then."""

    def log_trial_start(self, trial: Trial) -> None:
        trial.init_local_path()
        self._trial_writer[trial] = self._summary_writer_cls(trial.path, flush_secs=30)
        self._trial_result[trial] = {}

    def log_trial_result(self, _: int, trial: Trial, result: dict[str, Any]) -> None:
        if trial not in self._trial_writer:
            self.log_trial_start(trial)
        curves = {tag(name): value for name, value in result.items() if is_curve(name, value)}
        for name, value in curves.items():
            self._trial_writer[trial].add_scalar(name, value, global_step=result["timesteps_total"])
        self._trial_writer[trial].flush()
        # What the table of hyperparameters holds at the end.
        self._trial_result[trial] = self._trial_result[trial] | curves


def tag(curve: str) -> str:
    """The name of a curve in TensorBoard: `return` → `run/return`, `shared/kl` → `shared/kl`."""
    return curve if "/" in curve else f"{WHOLE}/{curve}"


def is_curve(name: str, value: Any) -> bool:
    """Whether an item of a result is a curve's value: a finite number that is not Tune's own bookkeeping."""
    return isinstance(value, int | float) and not isinstance(value, bool) and isfinite(value) and name not in NOT_CURVES
