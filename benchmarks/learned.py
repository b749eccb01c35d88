"""Training in one process, by the clock, and what came of it: shared by the parts of `benchmarks.learning`."""

import logging
import math
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

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

from league.config import LeagueConfig
from league.environments.building import interface
from training.trial import build

Z = 1.96


@dataclass(frozen=True, slots=True)
class Point:
    """One update: actions and seconds of training so far; the episodes that ended in it, and their mean return per
    agent of each policy."""

    steps: int
    seconds: float
    episodes: int
    returns: dict[str, float]


@dataclass(frozen=True, slots=True)
class Learned:
    """What a training came to.

    greedy, random: returns of agents in fresh episodes, in which the trained policies take their most probable actions,
    and in which all act at random; (episodes · agents,). parameters: trained numbers, shared ones counted once.
    """

    curve: list[Point]
    greedy: NDArray
    random: NDArray
    parameters: int

    @property
    def rate(self) -> float:
        """Actions per second of training."""
        return self.curve[-1].steps / self.curve[-1].seconds


@contextmanager
def local_ray(cpus: int) -> Iterator[None]:
    """A Ray of this process's own, quiet."""
    logging.disable(logging.WARNING)
    warnings.simplefilter("ignore")
    ray.init(address="local", num_cpus=cpus, include_dashboard=False, log_to_driver=False, logging_level="ERROR")
    try:
        yield
    finally:
        ray.shutdown()


def learn(
    league: LeagueConfig,
    *,
    episodes: int,
    seconds: float = math.inf,
    steps: float = math.inf,
    prepare: Callable[[Algorithm], None] | None = None,
) -> Learned:
    """Train for `seconds`, not counting what is not training, or for `steps` actions; then play `episodes` greedily and
    as many at random."""
    algorithm = build(league, interface(league))
    if prepare is not None:
        prepare(algorithm)
    try:
        curve = list(_updates(algorithm, seconds, steps))
        greedy, random = (_returns(algorithm, episodes, random_actions=random) for random in (False, True))
        return Learned(curve, greedy, random, _parameters(algorithm))
    finally:
        algorithm.stop()


def _updates(algorithm: Algorithm, seconds: float, steps: float) -> Iterator[Point]:
    taken, spent = 0, 0.0
    while spent < seconds and taken < steps:
        began = time.perf_counter()
        play = algorithm.train()[ENV_RUNNER_RESULTS]
        spent += time.perf_counter() - began
        taken += int(play[NUM_ENV_STEPS_SAMPLED])
        returns = {policy: float(value) for policy, value in play.get(EPISODE_MODULE_RETURN_MEAN, {}).items()}
        yield Point(taken, spent, int(play.get(NUM_EPISODES, 0)), returns)


def _returns(algorithm: Algorithm, episodes: int, random_actions: bool) -> NDArray:
    """Of the agents that the league's own policies play, in whole episodes."""
    chunks = algorithm.env_runner_group.foreach_env_runner(
        lambda runner: runner.sample(
            num_episodes=episodes, explore=False, random_actions=random_actions, force_reset=True
        ),
        local_env_runner=algorithm.env_runner_group.num_remote_env_runners() == 0,
    )
    return np.array([chunk.get_return() for own in chunks for chunk in own if chunk.is_done and chunk.t_started == 0])


def _parameters(algorithm: Algorithm) -> int:
    modules = algorithm.learner_group._learner.module.values()
    unique = {id(p): p.numel() for module in modules for p in module.parameters() if p.requires_grad}
    return sum(unique.values())


def one_thread() -> None:
    """Several processes learn at once, each on one core."""
    torch.set_num_threads(1)


def interval(values: NDArray) -> tuple[float, float]:
    """The two-sided 95 % interval of the mean of independent values, by the normal approximation."""
    mean, error = float(values.mean()), float(values.std(ddof=1) / len(values) ** 0.5)
    return mean - Z * error, mean + Z * error


def told(what: str, target: str, met: bool) -> bool:
    """Print whether a target is met."""
    print(f"{what}: target {target}: {'met' if met else 'MISSED'}", flush=True)
    return met
