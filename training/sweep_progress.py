"""A sweep's progress: a bar over all trials in a terminal, a line for each that is over elsewhere."""

from rich.console import Console
from rich.progress import TextColumn, TimeRemainingColumn

from training.progress import bars, clock
from training.search import Settings
from training.sweeps import Outcome, Sweep


class SweepProgress:
    """Use as a context manager around the sweep. Trials that are over already count as such."""

    def __init__(self, console: Console, sweep: Sweep, mode: str) -> None:
        self._console = console
        self._trials = sweep.record.trials
        self._sign = 1 if mode == "max" else -1
        over = {number: outcome for number in range(len(self._trials)) if (outcome := sweep.outcome(number))}
        self._scores = {number: outcome.score for number, outcome in over.items()}
        self._done = dict.fromkeys(over, 1.0)
        self._over = len(over)
        self._bars = bars(console, TimeRemainingColumn(), TextColumn("{task.fields[best]}"))
        self._bar = self._bars.add_task("", total=len(self._trials), best="")
        self._show()

    def __enter__(self) -> "SweepProgress":
        if self._console.is_terminal:
            self._bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._console.is_terminal:
            self._bars.stop()

    def update(self, number: int, outcome: Outcome, done: float) -> None:
        """Show how far a trial is, in [0, 1], and what has come of it so far."""
        self._done[number], self._scores[number] = done, outcome.score
        self._show()

    def over(self, number: int, outcome: Outcome) -> None:
        """Tell what came of a trial."""
        self._over += 1
        self._done[number] = 1.0
        self._show()
        early = ", ended early" if outcome.ended_early else ""
        self.say(
            f"{self._over} of {len(self._trials)}: trial {number} ({described(self._trials[number])}): "
            f"{scored(outcome.score)} after {outcome.steps:,} steps, {clock(outcome.seconds)}{early}"
        )

    def say(self, sentence: str) -> None:
        """A sentence of its own, above the bar."""
        self._console.print(sentence, highlight=False, markup=False, soft_wrap=True)

    def _show(self) -> None:
        scores = {number: score for number, score in self._scores.items() if score is not None}
        best = max(scores, key=lambda number: self._sign * scores[number], default=None)
        shown = "" if best is None else f"best: trial {best} with {scored(scores[best])}"
        description = f"{self._over} of {len(self._trials)} trials"
        self._bars.update(self._bar, completed=sum(self._done.values()), description=description, best=shown)


def described(settings: Settings) -> str:
    """The settings of a trial in a line: `lr 0.001, hidden [64, 64]`."""
    return ", ".join(f"{name} {value}" for name, value in settings.items())


def scored(score: float | None) -> str:
    """A score in a line."""
    return "no score" if score is None else f"{score:+.3f}"
