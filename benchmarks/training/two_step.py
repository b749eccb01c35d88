"""The two-step game by QMIX, VDN and independent Q-learning: returns and learned joint values."""

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from ray.rllib.algorithms.algorithm import Algorithm

from benchmarks.training.learned import greedy_returns, local_ray, one_thread, report_target, two_at_once
from league.config.league import LeagueConfig
from league.environments.building import interface
from policy_league.examples.two_step import ACTIONS, AGENTS, STATES, values
from training.runs.trial import build_algorithm

CONFIG = Path(__file__).parents[2] / "policy_league/configs" / "two_step_game.yaml"
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
        return float(np.abs(self.joint - values(gamma)).max())


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
    seen = [torch.cat([states, agents[i].expand(STATES, -1)], dim=1) for i in range(len(AGENTS))]
    first, second = (learner.module["shared"].values({"observation": rows}) for rows in seen)
    mixer = learner.mixer(learner.networks, "team")
    pairs = [(a, b) for a in range(ACTIONS) for b in range(ACTIONS)]
    mixed = [mixer(torch.stack([first[:, a], second[:, b]], dim=1), states).mean(-1) for a, b in pairs]
    return torch.stack(mixed, dim=1).reshape(STATES, ACTIONS, ACTIONS).numpy()


def work(job: tuple[str, int]) -> LearningResult:
    """Learn on the single core of this process."""
    one_thread()
    with local_ray(cpus=1):
        return learn(*job)


def two_step_game(scale: float) -> bool:
    """Twenty seeds of each mixer."""
    seeds = range(max(1, round(SEEDS * scale)))
    gamma = LeagueConfig.load(CONFIG).training.gamma
    jobs = [(mixer, seed) for mixer in RETURNS for seed in seeds]
    found = dict(zip(jobs, two_at_once(work, jobs), strict=True))
    for (mixer, seed), each in found.items():
        print(
            f"{mixer:>5} seed {seed:>2}: return {each.returned:g}, largest error {each.error(gamma):.2g},"
            f" {each.seconds:.1f} s; Q_tot {' | '.join(' '.join(f'{v:.2f}' for v in g.ravel()) for g in each.joint)}"
        )
    reached = {mixer: sum(found[mixer, seed].returned == best for seed in seeds) for mixer, best in RETURNS.items()}
    for mixer, best in RETURNS.items():
        print(f"{mixer:>5}: return {best:g} in {reached[mixer]} of {len(seeds)} seeds")
    worst = max(found["qmix", seed].error(gamma) for seed in seeds)
    slowest = max(each.seconds for each in found.values())
    print(f"largest error of the {STATES * ACTIONS**2} values by QMIX: {worst:.2g}; slowest seed: {slowest:.1f} s")
    return all(
        [
            report_target(
                "QMIX returns 8, VDN and none 7", "all seeds", all(count == len(seeds) for count in reached.values())
            ),
            report_target("largest error of a value by QMIX", f"below {NEAR:g}", worst < NEAR),
            report_target("a seed on one core", f"at most {MAX_SECONDS:g} s", slowest <= MAX_SECONDS),
        ]
    )
