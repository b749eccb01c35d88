"""The part of `benchmarks.learning` with pistonball: the return of the served policy, whose actions are greedy."""

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.training.learned import interval, local_ray, report_target, updates
from benchmarks.training.matches import games, graph
from league.config.league import LeagueConfig
from league.environments.building import interface
from training.runs.trial import build_algorithm

CONFIG = Path(__file__).parents[2] / "policy_league/configs" / "pistonball.yaml"
SEEDS = range(3)
SECONDS, EPISODES, TARGET = 1800.0, 32, 80.0


def pistonball(scale: float) -> bool:
    """Three seeds in turn, each for its budget of actions or 30 minutes on two cores: a runner on each."""
    met = True
    for seed in SEEDS:
        served = _served(seed, scale)
        met &= bool(served.mean() >= TARGET)
    return report_target("mean return of each seed's served policy", f"{TARGET:g}", met)


def _served(seed: int, scale: float) -> NDArray:
    """Train with a seed; print and return the returns of the exported graph in new episodes, (episodes,)."""
    league = LeagueConfig.load(CONFIG).with_training(seed=seed)
    with local_ray(cpus=3):
        algorithm = build_algorithm(league, interface(league))
        try:
            curve = list(updates(algorithm, SECONDS * scale, league.training.max_steps or math.inf))
            played = games(graph(algorithm, league), league, "script:random", 2 * EPISODES, seed)
        finally:
            algorithm.stop()
    # The two contestants play alone: half of the games are those of the random policy.
    served, random = (
        np.array([game.returns[contestant] for game in played if game.returns[contestant] is not None])
        for contestant in (0, 1)
    )
    last = curve[-1]
    print(f"seed {seed}: {last.steps:,} actions in {last.seconds:,.0f} s, {last.steps / last.seconds:,.0f} actions/s")
    for name, returns in (("served", served), ("random", random)):
        low, high = interval(returns)
        print(
            f"  {name}: {returns.mean():.2f} over {len(returns)} episodes, 95 % interval {low:.2f} … {high:.2f},"
            f" lowest {returns.min():.2f}"
        )
    ended = [point for point in curve if point.episodes]
    for point in ended[:: max(1, len(ended) // 10)]:
        print(f"    {point.steps:>9,} actions: {point.returns['piston']:8.2f} while exploring", flush=True)
    return served
