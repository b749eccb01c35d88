"""The part of `benchmarks.learning` with pistonball: the return of the served policy, whose actions are greedy."""

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from benchmarks.harness import CONFIGS, Target
from benchmarks.training.learned import local_ray, print_progress, updates
from benchmarks.training.matches import games, graph
from league.config.league import LeagueConfig
from league.environments.building import interface
from league.policies.policy import Policy
from training.runs.trial import build_algorithm

SEEDS = range(3)
SECONDS, EPISODES, TARGET = 1800.0, 32, 80.0


def pistonball(scale: float) -> Iterator[Target]:
    """Three seeds in turn, each for its budget of actions or 30 minutes on two cores: a runner on each."""
    means = np.array([[served.mean() for served in _served(seed, scale)] for seed in SEEDS])
    served, random = (tuple(round(float(value), 1) for value in column) for column in means.T)
    yield Target("pistonball, served", served, at_least=TARGET, note=f"random {', '.join(map(str, random))}")


def _served(seed: int, scale: float) -> list[NDArray]:
    """Train with a seed; the returns of the exported graph and of random play in new episodes, (episodes,) each."""
    league = LeagueConfig.load(CONFIGS / "pistonball.yaml").with_training(seed=seed)
    with local_ray(cpus=3):
        algorithm = build_algorithm(league, interface(league))
        try:
            curve = list(updates(algorithm, SECONDS * scale, league.training.max_steps or math.inf))
            served = returns(graph(algorithm, league), league, EPISODES, seed)
        finally:
            algorithm.stop()
    print_progress(f"pistonball, seed {seed}", curve)
    return served


def returns(trained: Policy, league: LeagueConfig, episodes: int, seed: int = 0) -> list[NDArray]:
    """The returns of a policy with greedy actions and of random play in new episodes, (episodes,) each."""
    # The two contestants play alone: half of the games are those of the random policy.
    played = games(trained, league, "script:random", 2 * episodes, seed)
    return [
        np.array([game.returns[contestant] for game in played if game.returns[contestant] is not None])
        for contestant in (0, 1)
    ]
