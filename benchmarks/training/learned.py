"""Training in one process with measured time, and its results: shared by the parts of `benchmarks.learning`."""

import logging
import math
import multiprocessing
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import ray
import torch
from numpy.typing import NDArray
from ray.rllib.algorithms.algorithm import Algorithm
from ray.rllib.utils.metrics import (
    ENV_RUNNER_RESULTS,
    EPISODE_MODULE_RETURN_MEAN,
    NUM_ENV_STEPS_SAMPLED,
    NUM_EPISODES,
)

from league.config.league import LeagueConfig
from league.config.schedules import ScheduleProgress
from league.environments.building import interface
from training.runs.trial import build_algorithm

Work = TypeVar("Work")
Result = TypeVar("Result")
Z = 1.96


@dataclass(frozen=True, slots=True)
class CurvePoint:
    """One update: actions and seconds of training so far; the episodes that ended in it, and their mean return per
    agent of each policy.
    """

    steps: int
    seconds: float
    episodes: int
    returns: dict[str, float]


@dataclass(frozen=True, slots=True)
class LearningCurve:
    """The results of a training.

    greedy, random: returns of agents in new episodes with greedy actions of the trained policies, and with random
    actions; (episodes · agents,). parameters: number of trained parameters, shared ones counted once.
    """

    curve: list[CurvePoint]
    greedy: NDArray
    random: NDArray
    parameters: int

    @property
    def rate(self) -> float:
        """Actions per second of training."""
        return self.curve[-1].steps / self.curve[-1].seconds


@contextmanager
def local_ray(cpus: int) -> Iterator[None]:
    """A local Ray without log output."""
    logging.disable(logging.WARNING)
    warnings.simplefilter("ignore")
    ray.init(address="local", num_cpus=cpus, include_dashboard=False, log_to_driver=False, logging_level="ERROR")
    try:
        yield
    finally:
        ray.shutdown()
        logging.disable(logging.NOTSET)


def learn(
    league: LeagueConfig,
    *,
    episodes: int,
    seconds: float = math.inf,
    steps: float = math.inf,
    prepare: Callable[[Algorithm], None] | None = None,
) -> LearningCurve:
    """Train for `seconds` of training time, or for `steps` actions; then play `episodes` greedily and as many at
    random.
    """
    algorithm = build_algorithm(league, interface(league))
    if prepare is not None:
        prepare(algorithm)
    try:
        curve = list(updates(algorithm, seconds, steps))
        greedy, random = greedy_returns(algorithm, episodes), _returns(algorithm, episodes, random_actions=True)
        return LearningCurve(curve, greedy, random, _parameters(algorithm))
    finally:
        algorithm.stop()


def updates(algorithm: Algorithm, seconds: float, steps: float) -> Iterator[CurvePoint]:
    """Train for `seconds` of training time, or for `steps` actions. Yields after each update."""
    steps_done, spent = 0, 0.0
    while spent < seconds and steps_done < steps:
        algorithm.progress = ScheduleProgress(steps_done, max(spent / seconds, steps_done / steps))
        began = time.perf_counter()
        play = algorithm.train()[ENV_RUNNER_RESULTS]
        spent += time.perf_counter() - began
        steps_done += int(play[NUM_ENV_STEPS_SAMPLED])
        returns = {policy: float(value) for policy, value in play.get(EPISODE_MODULE_RETURN_MEAN, {}).items()}
        yield CurvePoint(steps_done, spent, int(play.get(NUM_EPISODES, 0)), returns)


def print_progress(name: str, curve: Sequence[CurvePoint]) -> None:
    """Print the budget of a training, and about ten points of its curve."""
    print(f"{name}: {curve[-1].steps:,} actions in {curve[-1].seconds:,.0f} s", flush=True)
    ended = [point for point in curve if point.episodes]
    for point in ended[:: max(1, len(ended) // 10)]:
        returns = ", ".join(f"{policy} {value:.2f}" for policy, value in point.returns.items())
        print(f"    {point.steps:>9,} actions, while exploring: {returns}", flush=True)


def greedy_returns(algorithm: Algorithm, episodes: int) -> NDArray:
    """Returns of agents in this number of new episodes, with greedy actions."""
    return _returns(algorithm, episodes, random_actions=False)


def _returns(algorithm: Algorithm, episodes: int, random_actions: bool) -> NDArray:
    """Returns of the agents with the league's own policies, in complete episodes."""
    chunks = algorithm.env_runner_group.foreach_env_runner(
        lambda runner: runner.sample(
            num_episodes=episodes, explore=False, random_actions=random_actions, force_reset=True
        ),
        local_env_runner=algorithm.env_runner_group.num_remote_env_runners() == 0,
    )
    return np.array(
        [chunk.get_return() for runner in chunks for chunk in runner if chunk.is_done and chunk.t_started == 0]
    )


def _parameters(algorithm: Algorithm) -> int:
    modules = algorithm.learner_group._learner.module.values()
    unique = {id(p): p.numel() for module in modules for p in module.parameters() if p.requires_grad}
    return sum(unique.values())


def in_processes(work: Callable[[Work], Result], jobs: Sequence[Work], at_once: int = 2) -> Iterator[Result]:
    """Run each job in a subprocess, some at a time; yields the results in the order of the jobs."""
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(at_once, mp_context=spawn, max_tasks_per_child=1) as pool:
        yield from pool.map(work, jobs)


def one_thread() -> None:
    """Use one thread: several processes learn at once, each on one core."""
    torch.set_num_threads(1)


def interval(values: NDArray) -> tuple[float, float]:
    """The two-sided 95 % confidence interval of the mean of independent values, by the normal approximation."""
    mean, error = float(values.mean()), float(values.std(ddof=1) / len(values) ** 0.5)
    return mean - Z * error, mean + Z * error
