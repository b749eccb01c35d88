"""Displays a run's progress: a bar with steps/s, the shares of the phases, remaining time and returns in a terminal,
plain lines elsewhere."""

import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from statistics import fmean
from typing import Any, Self

from rich.console import Console
from rich.progress import BarColumn, ProgressColumn, TaskProgressColumn, TextColumn
from rich.progress import Progress as Bars

from league.config.training import TrainingSettings
from league.registry.storage.rows import StrengthRow, VersionRow
from training.algorithms.curriculum import STAGE
from training.algorithms.metrics import OTHER_TIME, PHASES, RUNNER_TIMES
from training.algorithms.resources import Resources
from training.runs.advice import advice, idle_share
from training.runs.callbacks import OWN_METRICS
from training.sampling.self_play import OPPONENTS

SECONDS_PER_LINE = 10.0
MAX_POLICIES = 3
"""Policies shown individually; TensorBoard has all."""
MAX_OPPONENTS = 3
"""Opponents shown, the most frequent ones."""
MAX_OWN_METRICS = 3
"""Metrics of callbacks shown."""
ZERO_RETURN = 0.005
"""Smaller returns are displayed as 0.00."""
OPPONENT_PREFIX = f"{OPPONENTS}/"
TIMES = (*PHASES, OTHER_TIME, *RUNNER_TIMES)
SHOWN_PHASES = ("time/sampling", "time/waiting", "time/learning")


class ProgressDisplay:
    """A bar with a percentage and further `columns`, in a terminal only. A context manager."""

    def __init__(self, console: Console, *columns: ProgressColumn) -> None:
        self._console = console
        description, percentage = TextColumn("{task.description}"), TaskProgressColumn()
        self._bars = Bars(description, BarColumn(24), percentage, *columns, console=console, transient=True)

    def __enter__(self) -> Self:
        if self._console.is_terminal:
            self._bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        # Stopping a bar that was not started prints an empty line.
        if self._console.is_terminal:
            self._bars.stop()

    def say(self, sentence: str) -> None:
        """Print a line above the bar."""
        self._console.print(sentence, highlight=False, markup=False, soft_wrap=True)


class TrainingProgress(ProgressDisplay):
    """The progress of a run. `published` and `measured` may be called from other threads."""

    def __init__(self, console: Console, settings: TrainingSettings, policies: Mapping[str, str]) -> None:
        """policies: agent → policy id."""
        super().__init__(console, TextColumn("{task.fields[pace]}"), TextColumn("{task.fields[doing]}"))
        self._settings = settings
        self._policies = policies
        self._bar = self._bars.add_task("Starting …", total=1.0, pace="", doing="")
        self._next_line = 0.0
        self._seconds: Counter[str] = Counter()
        self._gpu_uses: list[float] = []

    def update(self, metrics: Mapping[str, Any]) -> None:
        """Show a trial's latest metrics."""
        done = self._settings.budget_spent(metrics["steps"], metrics["seconds"])
        self._seconds.update({name: metrics[name] for name in TIMES if name in metrics})
        self._gpu_uses += [metrics["gpu/utilization"]] if "gpu/utilization" in metrics else []
        steps, pace = f"{metrics['steps']:,} steps", _pace(metrics, done)
        doing = policy_summaries(metrics, self._policies) + opponent_summary(metrics) + own_summary(metrics)
        if STAGE in metrics:
            doing = f"stage {metrics[STAGE]:.0f} of {len(self._settings.curriculum)}; {doing}"
        if self._console.is_terminal:
            self._bars.update(self._bar, completed=done, description=steps, pace=pace, doing=doing)
        elif time.monotonic() >= self._next_line or metrics.get("done"):
            self._next_line = time.monotonic() + SECONDS_PER_LINE
            self.say(f"{done:4.0%}  {steps}  {pace}  {doing}")

    def advise(self, used: Resources, cores: int) -> None:
        """Print what to change, if a resource of the run was idle. cores: of all nodes."""
        gpu_use = fmean(self._gpu_uses) / 100 if self._gpu_uses else None
        if (sentence := advice(self._seconds, used, self._settings, cores, gpu_use)) is not None:
            self.say(sentence)

    def published(self, version: VersionRow) -> None:
        """Print that a version was published."""
        parity = [policy.parity for policy in version.manifest.policies.values()]
        observations = sum(proof.observations for proof in parity)
        self.say(
            f"Published {version.ref} after {version.steps:,} steps: matches the trained policy on "
            f"{observations:,} observations."
        )

    def measured(self, version: VersionRow, rows: Sequence[StrengthRow]) -> None:
        """Print the scores of a version, each with its 95 % interval."""
        scores = ", ".join(
            f"{row.score:.1%} [{row.low:.1%}, {row.high:.1%}] against {row.opponent} ({row.games} games)"
            for row in rows
        )
        self.say(f"Strength of {version.ref} after {version.steps:,} steps: {scores}.")


def policy_summaries(metrics: Mapping[str, Any], policies: Mapping[str, str]) -> str:
    """Return a summary of the first few policies' metrics. policies: agent → policy id."""
    agents_of = {policy: [agent for agent in policies if policies[agent] == policy] for policy in policies.values()}
    formats = (("length", ".1f"), ("entropy", ".2f"))
    summaries = []
    for policy, agents in list(agents_of.items())[:MAX_POLICIES]:
        values = [f"{name} {metrics[key]:{form}}" for name, form in formats if (key := f"{policy}/{name}") in metrics]
        if (mean := metrics.get(f"{policy}/return")) is not None:
            # If the agents win what the others lose, the mean is 0, but the first one's return shows the advantage of
            # its side.
            first = metrics.get(f"agents/{agents[0]}/return", 0.0)
            is_zero_sum = abs(mean) < ZERO_RETURN <= abs(first)
            values.insert(0, f"return {first:+.2f} as {agents[0]}" if is_zero_sum else f"return {mean:+.2f}")
        summaries.append(f"{policy}: " + (", ".join(values) or "no finished episode yet"))
    more = len(agents_of) - MAX_POLICIES
    return "; ".join([*summaries, *([f"{more} more"] if more > 0 else [])])


def opponent_summary(metrics: Mapping[str, Any]) -> str:
    """Return the scores against the most frequent opponents; empty if there are none."""
    shares = {
        name.rpartition("/")[0]: value
        for name, value in metrics.items()
        if name.startswith(OPPONENT_PREFIX) and name.endswith("/share")
    }
    scores = {name: metrics[f"{name}/score"] for name in shares if f"{name}/score" in metrics}
    frequent = sorted(scores, key=lambda opponent: shares[opponent], reverse=True)[:MAX_OPPONENTS]
    score_texts = [f"{scores[name]:.0%} against {name.removeprefix(OPPONENT_PREFIX)}" for name in frequent]
    return f"; score {', '.join(score_texts)}" if score_texts else ""


def own_summary(metrics: Mapping[str, Any]) -> str:
    """Return the metrics of callbacks; empty if there are none."""
    values = {name: metrics[name] for name in metrics if name.startswith(OWN_METRICS)}
    texts = [f"{name.removeprefix(OWN_METRICS)} {values[name]:.4g}" for name in list(values)[:MAX_OWN_METRICS]]
    return f"; {', '.join(texts)}" if texts else ""


def _pace(metrics: Mapping[str, Any], done: float) -> str:
    """Return the speed, how the wall time since the last report was used, and the times."""
    speed = f"{metrics['steps_per_second']:,.0f} steps/s" if "steps_per_second" in metrics else ""
    if speed:
        use = ", ".join(_shares(metrics))
        speed += f" ({use})  " if use else "  "
    remaining_seconds = metrics["seconds"] * (1 - done) / done if done else 0.0
    return f"{speed}{clock(metrics['seconds'])} elapsed, {clock(remaining_seconds)} left"


def _shares(metrics: Mapping[str, Any]) -> Iterator[str]:
    """The shares of the phases in the time of the learner's process, how long runners were idle, and the GPU."""
    seconds = {name: metrics[name] for name in (*PHASES, OTHER_TIME) if name in metrics}
    total = sum(seconds.values())
    for name in SHOWN_PHASES:
        if name in seconds:
            yield f"{seconds[name] / total:.0%} {name.removeprefix('time/')}"
    if (idle := idle_share(metrics)) is not None:
        yield f"runners {idle:.0%} idle"
    if "gpu/memory_gb" in metrics:
        gpu_use = f"{metrics['gpu/utilization']:.0f}%, " if "gpu/utilization" in metrics else ""
        yield f"GPU {gpu_use}{metrics['gpu/memory_gb']:.1f} GB"


def clock(seconds: float) -> str:
    """Format seconds as minutes and seconds, with hours if needed."""
    minutes, remainder = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{remainder:02d}" if hours else f"{minutes}:{remainder:02d}"
