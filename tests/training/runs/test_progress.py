"""What a run prints, and the line at the end of a run that leaves a resource idle."""

import io
from collections.abc import Iterable

import pytest
from rich.console import Console

from league.config.ppo import PPOConfig
from training.algorithms.resources import Resources
from training.runs.advice import LEAST_SECONDS, advice, idle_share
from training.runs.progress import TrainingProgress, clock

SETTINGS = PPOConfig(steps=1000, minutes=2)
METRICS = {"steps": 250, "seconds": 60.0, "steps_per_second": 12.5, "a/return": 0.5, "a/length": 7.0, "a/entropy": 1.25}


def output_of(*updates: dict[str, object], terminal: bool = False, policies: Iterable[str] = ("a", "b")) -> str:
    """policies: of each agent in turn."""
    file = io.StringIO()
    console = Console(file=file, force_terminal=terminal, width=200)
    with TrainingProgress(console, SETTINGS, {f"agent_{i}": policy for i, policy in enumerate(policies)}) as progress:
        for metrics in updates:
            progress.update(metrics)
    return file.getvalue()


def test_a_line_has_the_progress_and_the_metrics_of_each_policy() -> None:
    """A quarter of the steps, but half of the time: the larger fraction counts."""
    (line,) = output_of(METRICS).splitlines()
    assert "50%  250 steps" in line
    assert "12 steps/s  1:00 elapsed, 1:00 left" in line
    assert "a: return +0.50, length 7.0, entropy 1.25; b: no finished episode yet" in line


def test_a_log_has_few_lines_but_the_last_one() -> None:
    lines = output_of(METRICS, METRICS, METRICS | {"steps": 1000, "done": True}).splitlines()
    assert len(lines) == 2
    assert "100%  1,000 steps" in lines[-1]


def test_the_number_of_policies_in_a_line_is_limited() -> None:
    (line,) = output_of(METRICS, policies=("a", "b", "c", "d", "e")).splitlines()
    assert line.endswith("c: no finished episode yet; 2 more")


def test_the_first_agents_return_is_shown_where_self_play_cancels_the_policys() -> None:
    """The policy plays both agents, of which one wins what the other loses."""
    agents = {"agents/agent_0/return": 0.25, "agents/agent_1/return": -0.25}
    (line,) = output_of(METRICS | agents | {"a/return": 0.0}, policies=("a", "a")).splitlines()
    assert "a: return +0.25 as agent_0, length 7.0" in line
    (line,) = output_of(METRICS | agents, policies=("a", "a")).splitlines()
    assert "a: return +0.50, length 7.0" in line
    (line,) = output_of(METRICS | {"a/return": 0.0, "agents/agent_0/return": 0.0}, policies=("a", "a")).splitlines()
    assert "a: return +0.00, length 7.0" in line


def test_a_terminal_has_a_progress_bar() -> None:
    output = output_of(METRICS, METRICS | {"steps": 750}, terminal=True)
    for part in ("━", "75%", "750 steps", "12 steps/s", "0:20 left", "return +0.50"):
        assert part in output


def test_a_report_without_an_update_has_no_speed() -> None:
    """For example if training is stopped before it starts."""
    (line,) = output_of({"steps": 0, "seconds": 0.0, "done": True}).splitlines()
    assert "0%  0 steps" in line
    assert "steps/s" not in line


def test_shares_of_sampling_and_learning_are_of_all_phases() -> None:
    phases = {"sampling": 0.5, "learning": 1.25, "weights": 0.15, "other": 0.1, "checkpoint": 9.0}
    (line,) = output_of(METRICS | {f"time/{name}": value for name, value in phases.items()}).splitlines()
    assert "12 steps/s (25% sampling, 62% learning)  1:00 elapsed" in line


def test_a_run_with_runners_and_a_gpu_shows_what_is_idle() -> None:
    phases = {
        "time/waiting": 0.1,
        "time/learning": 1.8,
        "time/other": 0.1,
        "time/runners_sampling": 1.0,
        "time/runners_idle": 3.0,
        "gpu/memory_gb": 1.25,
    }
    (line,) = output_of(METRICS | phases).splitlines()
    assert "12 steps/s (5% waiting, 90% learning, runners 75% idle, GPU 1.2 GB)  1:00" in line
    (line,) = output_of(METRICS | phases | {"gpu/utilization": 12.0}).splitlines()
    assert "runners 75% idle, GPU 12%, 1.2 GB)" in line


def test_the_advice_is_about_the_whole_run() -> None:
    file = io.StringIO()
    progress = TrainingProgress(Console(file=file, width=200), SETTINGS, {"agent_0": "a"})
    busy = {"time/learning": 20.0, "time/runners_sampling": 4.0, "time/runners_idle": 36.0}
    for use in (10.0, 30.0):
        progress.update(METRICS | busy | {"gpu/utilization": use})
    progress.advise(Resources(2, num_envs=8, threads=1, gpus=1.0), cores=16)
    line = file.getvalue().splitlines()[-1]
    assert "its 2 runners are idle 90%: learning limits the run. `runners: 1` is enough. The GPU is used 20%" in line


def test_durations_are_formatted_as_a_clock() -> None:
    assert [clock(seconds) for seconds in (0, 61.9, 3600, 36_061)] == ["0:00", "1:01", "1:00:00", "10:01:01"]


def test_the_most_frequent_opponents_are_shown_with_the_scores_against_them() -> None:
    shares = {"a@1": 0.1, "a@2": 0.2, "a@3": 0.3, "script:random": 0.4}
    scores = {f"opponents/{ref}/score": 0.25 for ref in shares}
    (line,) = output_of(
        METRICS | scores | {f"opponents/{ref}/share": share for ref, share in shares.items()}
    ).splitlines()
    assert line.endswith("; score 25% against script:random, 25% against a@3, 25% against a@2")


def test_opponents_whose_games_are_not_scored_are_not_shown() -> None:
    scored = {"opponents/a@1/share": 0.2, "opponents/a@1/score": 0.5}
    (line,) = output_of(METRICS | scored | {"opponents/a@2/share": 0.4}).splitlines()
    assert line.endswith("; score 50% against a@1")


def seconds(idle: float | None = None, **phases: float) -> dict[str, float]:
    """Of a run, in percent. phases: of the learner's process. idle: of the runners; None without any."""
    of_learner = {f"time/{name}": 10 * percent for name, percent in phases.items()}
    of_runners = {} if idle is None else {"time/runners_idle": idle, "time/runners_sampling": 100 - idle}
    return of_learner | of_runners


def said(
    times: dict[str, float], runners: int = 1, lag: int = 1, cores: int = 16, gpu_use: float | None = None
) -> str | None:
    used = Resources(runners, num_envs=32, threads=1, gpus=0.0)
    return advice(times, used, PPOConfig(lag=lag), cores, gpu_use)


def test_idle_runners_are_named_with_the_number_that_is_enough() -> None:
    assert said(seconds(idle=88, waiting=0, learning=98, other=2), runners=14) == (
        "The learner waits 0% of the time, its 14 runners are idle 88%: learning limits the run. `runners: 3` is"
        " enough. Use fewer epochs, larger minibatches or a smaller network (docs/limits.md#mostly-learning)."
    )


@pytest.mark.parametrize(
    ("gpu_use", "change"),
    [(None, "larger minibatches or a smaller network"), (0.1, "The GPU is used 10%"), (0.9, "Use fewer epochs or a")],
)
def test_one_idle_runner_means_that_learning_limits_the_run(gpu_use: float | None, change: str) -> None:
    sentence = said(seconds(idle=90, waiting=1, learning=99), gpu_use=gpu_use) or ""
    assert f"its runner is idle 90%: learning limits the run. {change}" in sentence.replace("Use fewer epochs, ", "")


@pytest.mark.parametrize(("cores", "change"), [(16, "Use more `runners`"), (2, "Use more cores")])
def test_a_learner_that_waits_needs_more_samples(cores: int, change: str) -> None:
    sentence = said(seconds(idle=3, waiting=40, learning=60), cores=cores) or ""
    assert f"waits 40% of the time, its runner is idle 3%: sampling limits the run. {change}" in sentence


def test_runners_and_learner_that_take_turns_could_overlap() -> None:
    times = seconds(idle=60, waiting=40, learning=60)
    assert "`lag: 1`" in (said(times, lag=0) or "")
    assert said(times) is None


def test_a_process_that_mostly_samples_could_have_runners() -> None:
    times = seconds(sampling=70, learning=30)
    assert "samples for 70% of the time: `runners` would" in (said(times, runners=0) or "")
    assert said(times, runners=0, cores=1) is None
    assert said(seconds(sampling=30, learning=70), runners=0) is None


def test_a_balanced_or_short_run_gets_no_advice() -> None:
    assert said(seconds(idle=30, waiting=10, learning=85, other=5)) is None
    short = {"time/waiting": 0.9 * LEAST_SECONDS, "time/runners_idle": 0.0, "time/runners_sampling": 10.0}
    assert said(short) is None
    assert idle_share({}) is None
