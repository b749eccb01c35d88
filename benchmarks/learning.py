"""Do the shipped configurations learn?

Each part trains one for a fixed time and measures the result.

Parts: rps, cars_and_lights, shared_encoder, simple_spread, simple_spread_large_minibatches, pistonball;
leduc_vs_random, leduc_holdem_dqn, connect_four_dqn by DQN; two_step_game, simple_spread_qmix. With several seeds or
opponents, two trainings run at a time, each in a process with one core; those of pistonball run in turn, on two cores.
All seeds are printed. Returns are per agent and episode, with greedy policies in new episodes, unless stated otherwise.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from ray.rllib.algorithms.algorithm import Algorithm
from scipy import stats

from benchmarks.harness import CONFIGS, Parts, Quick, Target, chosen
from benchmarks.optimal_play import crossing_optimum
from benchmarks.training.learned import (
    LearningCurve,
    in_processes,
    interval,
    learn,
    local_ray,
    one_thread,
    print_progress,
)
from benchmarks.training.pistonball import pistonball
from benchmarks.training.two_step import two_step_game
from benchmarks.training.value_learning import connect_four_dqn, leduc_holdem_dqn, leduc_vs_random
from league.config.league import LeagueConfig
from training.sampling.episode_chunks import EpisodeChunks

SEEDS = range(5)
SPREAD_STEPS, SPREAD_BETTER_BY = 1_000_000, 4.0
"""Equal numbers of actions for each seed, so that the ablation has the same experience; about two of the ten minutes
that the target allows.
"""
NEAR_OPTIMUM = 95.0
"""Percent of the distance from random play to the optimum."""


@dataclass(frozen=True, slots=True)
class LearningJob:
    """One training: configuration, settings and limits."""

    name: str
    settings: dict[str, object]
    seconds: float = math.inf
    steps: float = math.inf
    truncation_as_rllib: bool = False


def unless_done(chunks: EpisodeChunks) -> NDArray:
    """Whether the episode of each chunk continues. RLlib 2.60 flags agents that are truncated together as terminated:
    it then bootstraps only where a chunk was cut.
    """
    return ~(chunks.terminated | chunks.truncated)


def as_rllib(algorithm: Algorithm) -> None:
    """Treat truncation as RLlib does."""
    algorithm.learner_group._learner.bootstraps = unless_done


def work(job: LearningJob) -> LearningCurve:
    """Learn on the single core of this process."""
    one_thread()
    league = LeagueConfig.load(CONFIGS / f"{job.name}.yaml").with_training(**job.settings, runners=0)
    with local_ray(cpus=1):
        prepare = as_rllib if job.truncation_as_rllib else None
        return learn(league, seconds=job.seconds, steps=job.steps, episodes=400, prepare=prepare)


def rps(scale: float) -> Iterator[Target]:
    """The best response to each fixed opponent is known: it wins each round, or nothing against a random one."""
    rounds = 15.0
    best = {"script:first": rounds, "script:mirror": rounds, "script:random": 0.0}
    jobs = [LearningJob("rps", {"opponents": [ref]}, 30 * scale) for ref in best]
    for (ref, value), curve in zip(best.items(), in_processes(work, jobs), strict=True):
        low, high = interval(curve.greedy)
        # The interval of a best response contains its value.
        shortfall = max(0.0, value - high)
        note = f"return {curve.greedy.mean():.2f} [{low:.2f}, {high:.2f}], best response {value:g}"
        yield Target(f"rps against {ref}, below a best response by", shortfall, at_most=0.0, note=note)


def cars_and_lights(scale: float) -> Iterator[Target]:
    """Three seeds compared with the optimum, computed by the environment's solver."""
    best = crossing_optimum(**LeagueConfig.load(CONFIGS / "cars_and_lights.yaml").environment.kwargs)
    jobs = [LearningJob("cars_and_lights", {"seed": seed}, 120 * scale) for seed in range(3)]
    shares = [
        100 * (curve.greedy.mean() - curve.random.mean()) / (best - curve.random.mean())
        for curve in in_processes(work, jobs)
    ]
    yield Target("cars_and_lights, share of the optimum", _rounded(shares, 1), "%", at_least=NEAR_OPTIMUM)


def shared_encoder(scale: float) -> Iterator[Target]:
    """Five seeds with a shared encoder, five with separate networks."""
    jobs = [
        LearningJob("shared_encoder", {"shared_encoder": shared, "seed": seed}, 90 * scale)
        for shared in (True, False)
        for seed in SEEDS
    ]
    curves = list(in_processes(work, jobs))
    shared, separate = (np.array([curve.greedy.mean() for curve in part]) for part in (curves[:5], curves[5:]))
    low, _ = stats.t.interval(0.95, len(SEEDS) - 1, separate.mean(), stats.sem(separate))
    note = f"{curves[0].parameters:,} and {curves[5].parameters:,} parameters; separate {separate.mean():.2f}"
    peer = "the lower bound of separate networks"
    yield Target("shared_encoder, mean return", shared.mean(), at_least=float(low), peer=peer, note=note)


def simple_spread(scale: float) -> Iterator[Target]:
    """Five seeds, and the same five with truncation treated as termination, as in RLlib."""
    yield from _better_than_random("simple_spread", "simple_spread", SEEDS, scale)
    yield from _better_than_random("simple_spread, truncation as in RLlib", "simple_spread", SEEDS, scale, ablated=True)


def simple_spread_large_minibatches(scale: float) -> Iterator[Target]:
    """Three seeds with the network and the hyperparameters of the iteration that `benchmarks.sampling` times."""
    settings = {
        "train_batch_size": 12_000,
        "minibatch_size": 960,
        "epochs": 4,
        "hidden": [256, 256],
        "num_envs": "auto",
    }
    name = "simple_spread, large minibatches"
    yield from _better_than_random(name, "simple_spread", range(3), scale, settings)


def simple_spread_qmix(scale: float) -> Iterator[Target]:
    """Three seeds by QMIX."""
    yield from _better_than_random("simple_spread_qmix", "simple_spread_qmix", range(3), scale)


def _better_than_random(
    name: str,
    config: str,
    seeds: range,
    scale: float,
    settings: Mapping[str, object] | None = None,
    ablated: bool = False,
) -> Iterator[Target]:
    steps = SPREAD_STEPS * scale
    jobs = [LearningJob(config, {**(settings or {}), "seed": s}, math.inf, steps, ablated) for s in seeds]
    curves = list(in_processes(work, jobs))
    better = [curve.greedy.mean() - curve.random.mean() for curve in curves]
    for seed, curve in zip(seeds, curves, strict=True):
        print_progress(f"{name}, seed {seed}", curve.curve)
    least = None if ablated else SPREAD_BETTER_BY
    yield Target(f"{name}, better than random by", _rounded(better, 2), at_least=least)


def _rounded(values: Iterable[float], digits: int) -> tuple[float, ...]:
    return tuple(round(float(value), digits) for value in values)


PARTS: dict[str, Callable[[float], Iterator[Target]]] = {
    part.__name__: part
    for part in (
        *(rps, cars_and_lights, shared_encoder, simple_spread, simple_spread_large_minibatches, pistonball),
        *(leduc_vs_random, leduc_holdem_dqn, connect_four_dqn),
        *(two_step_game, simple_spread_qmix),
    )
}


def main(parts: Parts = None, quick: Quick = False) -> Iterator[Target]:
    """Train and measure the parts; a thirtieth of the time is enough for a smoke test."""
    for part in chosen(parts, PARTS).values():
        yield from part(1 / 30 if quick else 1.0)
