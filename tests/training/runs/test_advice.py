"""The line at the end of a run that leaves a resource idle."""

import pytest

from league.config.ppo import PPOConfig
from training.algorithms.resources import Resources
from training.runs.advice import LEAST_SECONDS, advice, idle_share


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
    sentence = said(seconds(idle=90, waiting=1, learning=99), gpu_use=gpu_use)
    assert sentence is not None
    assert f"its runner is idle 90%: learning limits the run. {change}" in sentence.replace("Use fewer epochs, ", "")


@pytest.mark.parametrize(("cores", "change"), [(16, "Use more `runners`"), (2, "Use more cores")])
def test_a_learner_that_waits_needs_more_samples(cores: int, change: str) -> None:
    sentence = said(seconds(idle=3, waiting=40, learning=60), cores=cores)
    assert sentence is not None
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
    balanced = seconds(idle=30, waiting=10, learning=85, other=5)
    assert said(balanced) is None
    short = {"time/waiting": 0.9 * LEAST_SECONDS, "time/runners_idle": 0.0, "time/runners_sampling": 10.0}
    assert said(short) is None
    assert idle_share({}) is None
