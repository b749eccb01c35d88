"""Do the shipped configurations learn? Each part trains one for a fixed time and measures the result.

Parts: rps, cars_and_lights, shared_encoder, simple_spread, simple_spread_large_minibatches, pistonball;
leduc_vs_random, leduc_holdem_dqn, connect_four_dqn by DQN; two_step_game, simple_spread_qmix. With several seeds or
opponents, two trainings run at a time, each in a process with one core; those of pistonball run in turn, on two cores.
All seeds are printed. Returns are per agent and episode, with greedy policies in new episodes, unless stated otherwise.
"""

import argparse
import math
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import stats

from benchmarks.training.learned import (
    LearningCurve,
    interval,
    learn,
    local_ray,
    one_thread,
    report_target,
    two_at_once,
)
from benchmarks.training.pistonball import pistonball
from benchmarks.training.truncation import as_rllib
from benchmarks.training.two_step import two_step_game
from benchmarks.training.value_learning import connect_four_dqn, leduc_holdem_dqn, leduc_vs_random
from league.config.league import LeagueConfig
from policy_league.examples import traffic

CONFIGS = Path(__file__).parent.parent / "policy_league/configs"
SEEDS = range(5)
SPREAD_STEPS, SPREAD_BETTER_BY = 1_000_000, 4.0
"""Equal numbers of actions for each seed, so that the ablation has the same experience; about two of the ten minutes
that the target allows.
"""
NEAR_OPTIMUM = 0.95
"""Fraction of the distance from random play to the optimum."""


@dataclass(frozen=True, slots=True)
class LearningJob:
    """One training: configuration, settings and limits."""

    name: str
    settings: dict[str, object]
    seconds: float = math.inf
    steps: float = math.inf
    truncation_as_rllib: bool = False


def work(job: LearningJob) -> LearningCurve:
    """Learn on the single core of this process."""
    one_thread()
    league = LeagueConfig.load(CONFIGS / f"{job.name}.yaml").with_training(**job.settings, runners=0)
    with local_ray(cpus=1):
        prepare = as_rllib if job.truncation_as_rllib else None
        return learn(league, seconds=job.seconds, steps=job.steps, episodes=400, prepare=prepare)


def rps(scale: float) -> bool:
    """The best response to each fixed opponent is known: it wins each round, or nothing against a random one."""
    rounds = 15.0
    best = {"script:first": rounds, "script:mirror": rounds, "script:random": 0.0}
    met = True
    jobs = [LearningJob("rps", {"opponents": [ref]}, 30 * scale) for ref in best]
    for (ref, value), learned in zip(best.items(), two_at_once(work, jobs), strict=True):
        low, high = interval(learned.greedy)
        met &= low <= value <= high or learned.greedy.mean() >= value
        print(
            f"against {ref}: return {learned.greedy.mean():.2f} per episode of {rounds:g} rounds"
            f" (95 % interval {low:.2f} … {high:.2f}), best response {value:g}"
        )
    return report_target("best-response value against each opponent", "reached", met)


def cars_and_lights(scale: float) -> bool:
    """Three seeds compared with the optimum, computed by the environment's solver."""
    league = LeagueConfig.load(CONFIGS / "cars_and_lights.yaml")
    best = traffic.optimum(**league.environment.kwargs)
    jobs = [LearningJob("cars_and_lights", {"seed": seed}, 120 * scale) for seed in range(3)]
    met = True
    for seed, learned in zip(range(3), two_at_once(work, jobs), strict=True):
        own, other = learned.greedy.mean(), learned.random.mean()
        share = (own - other) / (best - other)
        met &= bool(share >= NEAR_OPTIMUM)
        print(
            f"seed {seed}: {learned.curve[-1].steps:,} actions; return {own:.3f}, random {other:.3f},"
            f" optimum {best:.3f}: {share:.1%} of the way"
        )
    return report_target("way from random to the optimum", f"{NEAR_OPTIMUM:.0%}", met)


def shared_encoder(scale: float) -> bool:
    """Five seeds with a shared encoder, five with separate networks."""
    settings = {"shared": {"shared_encoder": True}, "separate": {"shared_encoder": False}}
    jobs = [LearningJob("shared_encoder", own | {"seed": s}, 90 * scale) for own in settings.values() for s in SEEDS]
    learned = list(two_at_once(work, jobs))
    means = {}
    for label, part in zip(settings, (learned[:5], learned[5:]), strict=True):
        means[label] = np.array([each.greedy.mean() for each in part])
        shown = ", ".join(f"{value:.2f}" for value in means[label])
        steps = np.mean([each.curve[-1].steps for each in part])
        print(
            f"{label:>8}: {part[0].parameters:,} parameters; returns of seeds 0 … 4: {shown};"
            f" mean {means[label].mean():.2f}; {steps:,.0f} actions each"
        )
    low, high = stats.t.interval(0.95, len(SEEDS) - 1, means["separate"].mean(), stats.sem(means["separate"]))
    print(f"  95 % interval of the separate networks' mean: {low:.2f} … {high:.2f}")
    return report_target(
        "mean with a shared encoder", "within that interval or above", bool(means["shared"].mean() >= low)
    )


def simple_spread(scale: float) -> bool:
    """Five seeds, and the same five with truncation treated as termination, as in RLlib."""
    jobs = [
        LearningJob("simple_spread", {"seed": seed}, steps=SPREAD_STEPS * scale, truncation_as_rllib=ablated)
        for ablated in (False, True)
        for seed in SEEDS
    ]
    learned = list(two_at_once(work, jobs))
    met = True
    print(
        f"{'truncation':>12} {'seed':>5} {'actions':>11} {'seconds':>8} {'return':>8} {'random':>8} {'better by':>10}"
    )
    for job, each in zip(jobs, learned, strict=True):
        last, better = each.curve[-1], each.greedy.mean() - each.random.mean()
        label = "as RLlib" if job.truncation_as_rllib else "bootstraps"
        print(
            f"{label:>12} {job.settings['seed']:>5} {last.steps:>11,} {last.seconds:>8.0f} {each.greedy.mean():>8.2f}"
            f" {each.random.mean():>8.2f} {better:>10.2f}"
        )
        met &= job.truncation_as_rllib or bool(better >= SPREAD_BETTER_BY)
    for label, part in (("bootstraps", learned[:5]), ("as RLlib", learned[5:])):
        finals = np.array([each.greedy.mean() for each in part])
        print(f"  truncation {label}: {finals.mean():.2f} ± {finals.std(ddof=1):.2f} over the seeds")
    return report_target("each seed better than random by", f"{SPREAD_BETTER_BY:g} per agent", met)


def simple_spread_large_minibatches(scale: float) -> bool:
    """Three seeds with the network and the hyperparameters of the iteration that `benchmarks.sampling` times."""
    settings = {
        "train_batch_size": 12_000,
        "minibatch_size": 960,
        "epochs": 4,
        "hidden": [256, 256],
        "num_envs": "auto",
    }
    jobs = [LearningJob("simple_spread", settings | {"seed": seed}, steps=SPREAD_STEPS * scale) for seed in range(3)]
    met = True
    for job, each in zip(jobs, two_at_once(work, jobs), strict=True):
        last, better = each.curve[-1], each.greedy.mean() - each.random.mean()
        print(
            f"seed {job.settings['seed']}: {last.steps:,} actions in {last.seconds:.0f} s; return"
            f" {each.greedy.mean():.2f}, random {each.random.mean():.2f}, better by {better:.2f}"
        )
        met &= bool(better >= SPREAD_BETTER_BY)
    return report_target("each seed better than random by", f"{SPREAD_BETTER_BY:g} per agent", met)


def simple_spread_qmix(scale: float) -> bool:
    """Three seeds by QMIX, each with its curve."""
    jobs = [LearningJob("simple_spread_qmix", {"seed": seed}, steps=SPREAD_STEPS * scale) for seed in range(3)]
    met = True
    for job, each in zip(jobs, two_at_once(work, jobs), strict=True):
        last, better = each.curve[-1], each.greedy.mean() - each.random.mean()
        print(
            f"seed {job.settings['seed']}: {last.steps:,} actions in {last.seconds:.0f} s; return"
            f" {each.greedy.mean():.2f}, random {each.random.mean():.2f}, better by {better:.2f}"
        )
        ended = [point for point in each.curve if point.episodes]
        for point in ended[:: max(1, len(ended) // 10)]:
            print(f"    {point.steps:>9,} actions: {point.returns['shared']:8.2f} while exploring")
        met &= bool(better >= SPREAD_BETTER_BY)
    return report_target("each seed better than random by", f"{SPREAD_BETTER_BY:g} per agent", met)


PARTS: dict[str, Callable[[float], bool]] = {
    part.__name__: part
    for part in (
        *(rps, cars_and_lights, shared_encoder, simple_spread, simple_spread_large_minibatches, pistonball),
        *(leduc_vs_random, leduc_holdem_dqn, connect_four_dqn),
        *(two_step_game, simple_spread_qmix),
    )
}


def main() -> int:
    """Run the requested parts; 1 if a target is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"some of {', '.join(PARTS)}; default: all")
    parser.add_argument("--quick", action="store_true", help="a thirtieth of the time")
    options = parser.parse_args()
    if unknown := [part for part in options.parts if part not in PARTS]:
        parser.error(f"no part {', '.join(unknown)}: expected some of {', '.join(PARTS)}")
    missed = []
    for name in options.parts or PARTS:
        print(f"\n-- {name} --", flush=True)
        if not PARTS[name](1 / 30 if options.quick else 1.0):
            missed.append(name)
    print(f"\nmissed: {', '.join(missed)}" if missed else "\nall met")
    return bool(missed)


if __name__ == "__main__":
    sys.exit(main())
