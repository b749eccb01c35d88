"""One trial of a sweep, and what hears of all of them in the driver's process."""

import shutil
from collections import defaultdict, deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ray import tune
from ray.tune.experiment import Trial as TuneTrial

from training.progress import fraction
from training.sweep_progress import SweepProgress
from training.sweeps import Outcome, Sweep
from training.trial import Trial
from training.tuning import Unpickled

TRIAL = "trial"
NUMBER = "number"
LAST = 5
"""Reports whose mean is a trial's score: one alone is noisy."""


class SweepTrial(Trial):
    """A Trial that keeps only its newest checkpoint, and repeats the metric until it has a new value: schedulers want
    one. config: `trial`, its number and settings. plans: what Trial is given, by number."""

    def setup(  # type: ignore[override]  # Tune's with_parameters gives the others
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
        for other in newest.parent.iterdir():
            if other != newest:
                shutil.rmtree(other)
        return newest


class Watch(Unpickled, tune.Callback):
    """Records what comes of each trial, shows it, and knows when a sweep that was asked to end has come to rest."""

    def __init__(self, sweep: Sweep, metric: str, progress: SweepProgress) -> None:
        self._sweep = sweep
        self._metric = metric
        self._progress = progress
        self._scores: dict[int, deque[float]] = defaultdict(lambda: deque(maxlen=LAST))
        self._running: set[int] = set()
        self._awaited: set[int] | None = None

    def ask_to_end(self) -> None:
        """Let the trials that run now save; no other is begun."""
        self._awaited = set(self._running)
        self._sweep.end.touch()
        self._progress.say("Ending when the trials under way have saved. Ctrl-C again ends at once.")

    @property
    def is_at_rest(self) -> bool:
        """Whether it was asked to end, and all that ran then has saved."""
        return self._awaited is not None and not self._awaited & self._running

    def on_trial_start(self, *, trial: TuneTrial, **_: Any) -> None:
        self._running.add(_number(trial))

    def on_trial_result(self, *, trial: TuneTrial, result: dict[str, Any], **_: Any) -> None:
        number = _number(trial)
        if self._metric in result:
            self._scores[number].append(result[self._metric])
        scores = self._scores[number]
        score = sum(scores) / len(scores) if scores else None
        outcome = Outcome(
            score=score, steps=result["steps"], seconds=result["seconds"], ended_early=not result["spent"]
        )
        self._progress.update(number, outcome, fraction(result, self._sweep.league(number).training))
        if result["done"]:
            self._running.discard(number)
            if result["spent"] or self._awaited is None:
                self._sweep.set_outcome(number, outcome)
                self._progress.over(number, outcome)

    def on_trial_error(self, *, trial: TuneTrial, **_: Any) -> None:
        self._running.discard(_number(trial))


class StopAtRest(Unpickled, tune.Stopper):
    """Ends a sweep that was asked to end."""

    def __init__(self, watch: Watch) -> None:
        self._watch = watch

    def __call__(self, *_: Any) -> bool:
        return False

    def stop_all(self) -> bool:
        return self._watch.is_at_rest


def _number(trial: TuneTrial) -> int:
    return int(trial.config[TRIAL][NUMBER])
