"""The two-step game by QMIX, VDN and independent Q-learning: returns and learned joint values."""

import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from ray.rllib.algorithms.algorithm import Algorithm

from benchmarks.harness import CONFIGS, Target
from benchmarks.optimal_play import two_step_values
from benchmarks.training.learned import greedy_returns, in_processes, local_ray, one_thread
from league.config.league import LeagueConfig
from league.environments.building import interface
from policy_league.examples.two_step import ACTIONS, AGENTS, STATES
from training.runs.trial import build_algorithm

CONFIG = CONFIGS / "two_step_game.yaml"
SEEDS, MAX_SECONDS, NEAR = 20, 60.0, 0.1
RETURNS = {"qmix": 8.0, "vdn": 7.0, "none": 7.0}
"""Of greedy play: QMIX finds the optimum, the others cannot."""
EPISODES = 4
"""All are identical: nothing in the game is random."""


@dataclass(frozen=True, slots=True)
class LearningResult:
    """returned: greedy return per agent and episode. joint: (3, 2, 2) the team's value of each pair of actions in each
    state; without mixing, the mean of both agents' values. seconds: CPU time of training.
    """

    returned: float
    joint: NDArray
    seconds: float

    def error(self, gamma: float) -> float:
        """Largest difference from the closed form."""
        return float(np.abs(self.joint - two_step_values(gamma)).max())


def learn(mixer: str, seed: int, **settings: object) -> LearningResult:
    """Train with the shipped configuration, in this process."""
    league = LeagueConfig.load(CONFIG).with_training(mixer=mixer, seed=seed, **settings)
    algorithm = build_algorithm(league, interface(league))
    try:
        began = time.process_time()
        while league.training.budget_spent(algorithm.steps, seconds=0) < 1:
            algorithm.train()
        seconds = time.process_time() - began
        returned = greedy_returns(algorithm, EPISODES).mean()
        return LearningResult(float(returned), joint_values(algorithm), seconds)
    finally:
        algorithm.stop()


@torch.no_grad()
def joint_values(algorithm: Algorithm) -> NDArray:
    """(3, 2, 2) the learned value of each pair of actions in each state."""
    learner = algorithm.learner_group._learner
    states, agents = torch.eye(STATES), torch.eye(len(AGENTS))
    observations = [torch.cat([states, agents[i].expand(STATES, -1)], dim=1) for i in range(len(AGENTS))]
    first, second = (learner.module["shared"].values({"observation": rows}) for rows in observations)
    mixer = learner.mixer(learner.networks, "team")
    pairs = [(a, b) for a in range(ACTIONS) for b in range(ACTIONS)]
    mixed = [mixer(torch.stack([first[:, a], second[:, b]], dim=1), states).mean(-1) for a, b in pairs]
    return torch.stack(mixed, dim=1).reshape(STATES, ACTIONS, ACTIONS).numpy()


def work(job: tuple[str, int]) -> LearningResult:
    """Learn on the single core of this process."""
    one_thread()
    with local_ray(cpus=1):
        return learn(*job)


def two_step_game(scale: float) -> Iterator[Target]:
    """Twenty seeds of each mixer."""
    seeds = range(max(1, round(SEEDS * scale)))
    gamma = LeagueConfig.load(CONFIG).training.gamma
    jobs = [(mixer, seed) for mixer in RETURNS for seed in seeds]
    results = dict(zip(jobs, in_processes(work, jobs), strict=True))
    for mixer, best in RETURNS.items():
        reached = sum(results[mixer, seed].returned == best for seed in seeds)
        name = f"two_step_game, {mixer}, seeds with return {best:g}"
        yield Target(name, reached, f"of {len(seeds)}", at_least=len(seeds))
    worst = max(results["qmix", seed].error(gamma) for seed in seeds)
    yield Target("two_step_game, largest error of a value by QMIX", worst, at_most=NEAR)
    slowest = max(result.seconds for result in results.values())
    yield Target("two_step_game, slowest seed", round(slowest, 1), "s", at_most=MAX_SECONDS)
