"""A trial of a sweep, the driver's callback, and the display of progress."""

from collections import defaultdict, deque
from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from ray import tune
from ray.tune.experiment import Trial as TuneTrial
from ray.tune.search import Searcher
from rich.console import Console
from rich.progress import TextColumn, TimeRemainingColumn

from league.config.base import JSON
from league.errors import LeagueError
from league.interface import Interface
from training.rllib_compat import NotPickled
from training.runs.progress import ProgressDisplay, clock
from training.runs.trial import Trial, TrialPlan
from training.sweeps.search_space import TrialOutcome, format_settings
from training.sweeps.strength import HIGH, LOW, STRENGTH, StrengthTest, trial_strength
from training.sweeps.sweep_directory import SweepDirectory


class SweepProgress(ProgressDisplay):
    """The progress of a sweep. Trials that have already ended are counted."""

    def __init__(self, console: Console, sweep: SweepDirectory, mode: str) -> None:
        super().__init__(console, TimeRemainingColumn(), TextColumn("{task.fields[best]}"))
        self._sweep = sweep
        self._sign = 1 if mode == "max" else -1
        over = {number: outcome for number in range(sweep.size) if (outcome := sweep.outcome(number))}
        self._outcomes = dict(over)
        self._done = dict.fromkeys(over, 1.0)
        self._over = len(over)
        self._bar = self._bars.add_task("", total=sweep.size, best="")
        self._show()

    def update(self, number: int, outcome: TrialOutcome, done: float) -> None:
        """Show the fraction of a trial's budget spent, in [0, 1], and its result so far."""
        self._done[number], self._outcomes[number] = done, outcome
        self._show()

    def over(self, number: int, outcome: TrialOutcome) -> None:
        """Print the result of a trial."""
        self._over += 1
        self._done[number] = 1.0
        self._show()
        early = ", ended early" if outcome.ended_early else ""
        self.say(
            f"{self._over} of {self._sweep.size}: trial {number} "
            f"({format_settings(self._sweep.record.trials[number])}): "
            f"{format_score(outcome)} after {outcome.steps:,} steps, {clock(outcome.seconds)}{early}"
        )

    def _show(self) -> None:
        scores = {number: outcome.score for number, outcome in self._outcomes.items() if outcome.score is not None}
        best = max(scores, key=lambda number: self._sign * scores[number], default=None)
        summary = "" if best is None else f"best: trial {best} with {format_score(self._outcomes[best])}"
        description = f"{self._over} of {self._sweep.size} trials"
        self._bars.update(self._bar, completed=sum(self._done.values()), description=description, best=summary)


def format_score(outcome: TrialOutcome) -> str:
    """Format the score of a trial, with its interval if there is one."""
    if outcome.score is None:
        return "no score"
    if outcome.low is None or outcome.high is None:
        return f"{outcome.score:+.3f}"
    return f"{outcome.score:.1%} [{outcome.low:.1%}, {outcome.high:.1%}]"


TRIAL = "trial"
NUMBER = "number"
ARGUMENTS = "arguments"
SCORE_REPORTS = 5
"""Number of last reports whose mean is a trial's score: a single one is noisy. Of strength, only the last one counts,
which has an interval."""


@dataclass(frozen=True, slots=True, repr=False)
class TrialArguments:
    """What a Trial is built from. Not a dictionary, whose items Tune would show among the settings of the trial."""

    league: JSON
    """Its algorithm is imported before its settings are read."""
    interface: Interface
    plan: TrialPlan


class PlannedTrials(NotPickled, Searcher):
    """Gives Tune the configurations that `trials` yields, each when it can start.

    Saves nothing: the state of the trials is in the sweep's directory.
    """

    def __init__(self, trials: Iterator[dict[str, Any]]) -> None:
        super().__init__()
        self._trials = trials

    def suggest(self, _: str) -> dict[str, Any] | str:
        return next(self._trials, Searcher.FINISHED)

    def on_trial_complete(self, *_: Any, **__: Any) -> None:
        """Do nothing: SweepCallback records the outcome."""

    def save(self, _: str) -> None:
        """Do nothing."""


class SweepTrial(Trial):
    """A Trial that keeps its newest checkpoint only, and repeats the metric's last value, since schedulers require one.

    config: `trial`, its number and settings, and `arguments`. strength: how its strength is measured at each
    checkpoint, if that is the metric.
    """

    def setup(  # type: ignore[override]  # Tune's with_parameters passes the others
        self, config: dict[str, Any], metric: str, strength: StrengthTest | None
    ) -> None:
        arguments: TrialArguments = config[ARGUMENTS]
        super().setup({field.name: getattr(arguments, field.name) for field in fields(arguments)})
        self._metric = metric
        self._strength = strength
        self._games = None if strength is None else strength.open_games(self.plan.storage)
        self._checkpoint = self.plan.start.checkpoint
        self._newest: dict[str, Any] = {}

    def step(self) -> dict[str, Any]:
        metrics = super().step()
        is_stopped = metrics["done"] and not metrics["spent"]
        if not is_stopped and ("checkpoint" in metrics or (metrics["spent"] and not self._newest)):
            metrics |= self._measured(is_last=metrics["spent"])
        if self._metric in metrics:
            self._newest = {name: metrics[name] for name in (self._metric, LOW, HIGH) if name in metrics}
        return self._newest | metrics

    def cleanup(self) -> None:
        if self._games is not None:
            self._games.close()
        super().cleanup()

    def _measured(self, is_last: bool) -> dict[str, float]:
        """Return the strength of the newest checkpoint. A failure ends a trial only if this is its last checkpoint."""
        if self._strength is None or self._games is None or self._checkpoint is None:
            return {}
        try:
            checkpoint = self.files.fetch(self._checkpoint)
            return trial_strength(checkpoint, self.league, self.interface, self._strength.opponents, self._games)
        except LeagueError:
            if is_last:
                raise
            return {}

    def _save(self) -> Path:
        self._checkpoint = super()._save()
        self.files.keep_only(self._checkpoint)
        return self._checkpoint


class SweepCallback(NotPickled, tune.Callback):
    """Records and shows each trial's result, and tracks which trials have saved after a stop request."""

    def __init__(self, sweep: SweepDirectory, metric: str, progress: SweepProgress) -> None:
        self._sweep = sweep
        self._metric = metric
        self._progress = progress
        reports = 1 if metric == STRENGTH else SCORE_REPORTS
        self._scores: dict[int, deque[float]] = defaultdict(lambda: deque(maxlen=reports))
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
            score=score,
            low=result.get(LOW),
            high=result.get(HIGH),
            steps=result["steps"],
            seconds=result["seconds"],
            ended_early=not result["spent"],
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
