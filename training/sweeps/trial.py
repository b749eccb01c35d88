"""A trial of a sweep, the driver's callback, and the display of progress."""

from collections import defaultdict, deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ray import tune
from ray.tune.experiment import Trial as TuneTrial
from rich.console import Console
from rich.progress import TextColumn, TimeRemainingColumn

from training.rllib_compat import NotPickled
from training.runs.progress import ProgressDisplay, clock
from training.runs.trial import Trial
from training.sweeps.search_space import Settings
from training.sweeps.sweep_directory import SweepDirectory, TrialOutcome


class SweepProgress(ProgressDisplay):
    """The progress of a sweep. Trials that have already ended are counted."""

    def __init__(self, console: Console, sweep: SweepDirectory, mode: str) -> None:
        super().__init__(console, TimeRemainingColumn(), TextColumn("{task.fields[best]}"))
        self._trials = sweep.record.trials
        self._sign = 1 if mode == "max" else -1
        over = {number: outcome for number in range(len(self._trials)) if (outcome := sweep.outcome(number))}
        self._scores = {number: outcome.score for number, outcome in over.items()}
        self._done = dict.fromkeys(over, 1.0)
        self._over = len(over)
        self._bar = self._bars.add_task("", total=len(self._trials), best="")
        self._show()

    def update(self, number: int, outcome: TrialOutcome, done: float) -> None:
        """Show the fraction of a trial's budget spent, in [0, 1], and its result so far."""
        self._done[number], self._scores[number] = done, outcome.score
        self._show()

    def over(self, number: int, outcome: TrialOutcome) -> None:
        """Print the result of a trial."""
        self._over += 1
        self._done[number] = 1.0
        self._show()
        early = ", ended early" if outcome.ended_early else ""
        self.say(
            f"{self._over} of {len(self._trials)}: trial {number} ({format_settings(self._trials[number])}): "
            f"{format_score(outcome.score)} after {outcome.steps:,} steps, {clock(outcome.seconds)}{early}"
        )

    def _show(self) -> None:
        scores = {number: score for number, score in self._scores.items() if score is not None}
        best = max(scores, key=lambda number: self._sign * scores[number], default=None)
        summary = "" if best is None else f"best: trial {best} with {format_score(scores[best])}"
        description = f"{self._over} of {len(self._trials)} trials"
        self._bars.update(self._bar, completed=sum(self._done.values()), description=description, best=summary)


def format_settings(settings: Settings) -> str:
    """Format the settings of a trial: `lr 0.001, hidden [64, 64]`."""
    return ", ".join(f"{name} {value}" for name, value in settings.items())


def format_score(score: float | None) -> str:
    """Format a score."""
    return "no score" if score is None else f"{score:+.3f}"


TRIAL = "trial"
NUMBER = "number"
SCORE_REPORTS = 5
"""Number of last reports whose mean is a trial's score: a single one is noisy."""


class SweepTrial(Trial):
    """A Trial that keeps its newest checkpoint only, and repeats the metric's last value, since schedulers require one.

    config: `trial`, its number and settings. plans: number → configuration of the Trial.
    """

    def setup(  # type: ignore[override]  # Tune's with_parameters passes the others
        self, config: dict[str, Any], plans: Mapping[int, dict[str, Any]], metric: str
    ) -> None:
        super().setup(plans[config[TRIAL][NUMBER]])
        self._metric = metric
        self._newest: dict[str, Any] = {}

    def step(self) -> dict[str, Any]:
        metrics = super().step()
        if self._metric in metrics:
            self._newest = {self._metric: metrics[self._metric]}
        return self._newest | metrics

    def _save(self) -> Path:
        newest = super()._save()
        self.files.keep_only(newest)
        return newest


class SweepCallback(NotPickled, tune.Callback):
    """Records and shows each trial's result, and tracks which trials have saved after a stop request."""

    def __init__(self, sweep: SweepDirectory, metric: str, progress: SweepProgress) -> None:
        self._sweep = sweep
        self._metric = metric
        self._progress = progress
        self._scores: dict[int, deque[float]] = defaultdict(lambda: deque(maxlen=SCORE_REPORTS))
        self._running: set[int] = set()
        self._awaited: set[int] | None = None

    def request_stop(self) -> None:
        """Let running trials save, and start no others."""
        self._awaited = set(self._running)
        self._sweep.stop_file.touch()
        self._progress.say("Ending after the running trials have saved. Press Ctrl-C again to end immediately.")

    @property
    def has_stopped(self) -> bool:
        """Whether a stop was requested, and all trials running at that time have saved."""
        return self._awaited is not None and not self._awaited & self._running

    def on_trial_start(self, *, trial: TuneTrial, **_: Any) -> None:
        self._running.add(_number(trial))

    def on_trial_result(self, *, trial: TuneTrial, result: dict[str, Any], **_: Any) -> None:
        number = _number(trial)
        if self._metric in result:
            self._scores[number].append(result[self._metric])
        scores = self._scores[number]
        score = sum(scores) / len(scores) if scores else None
        outcome = TrialOutcome(
            score=score, steps=result["steps"], seconds=result["seconds"], ended_early=not result["spent"]
        )
        training = self._sweep.league(number).training
        self._progress.update(number, outcome, training.budget_spent(outcome.steps, outcome.seconds))
        if result["done"]:
            self._running.discard(number)
            if result["spent"] or self._awaited is None:
                self._sweep.set_outcome(number, outcome)
                self._progress.over(number, outcome)

    def on_trial_error(self, *, trial: TuneTrial, **_: Any) -> None:
        self._running.discard(_number(trial))


class StopWhenSaved(NotPickled, tune.Stopper):
    """Ends a sweep after a stop request."""

    def __init__(self, watch: SweepCallback) -> None:
        self._watch = watch

    def __call__(self, *_: Any) -> bool:
        return False

    def stop_all(self) -> bool:
        return self._watch.has_stopped


def _number(trial: TuneTrial) -> int:
    return int(trial.config[TRIAL][NUMBER])
