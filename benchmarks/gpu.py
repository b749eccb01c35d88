"""What does a GPU save in training? Run on a machine with one: learner, and learner and sampling, against the CPU.

For each configuration: seconds of sampling and of learning per 1,000 actions, and the time in total relative to that of
the CPU. All is done in one process, with four threads, after the first updates.
"""

import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch
from ray.rllib.utils.metrics import ENV_RUNNER_RESULTS, NUM_ENV_STEPS_SAMPLED

from benchmarks.harness import CONFIGS, Parts, Quick, Target, chosen
from benchmarks.training.learned import local_ray
from league.config.league import LeagueConfig
from league.environments.building import interface
from training.algorithms.metrics import PHASES, totals
from training.runs.trial import MAX_THREADS, build_algorithm

SAMPLING, LEARNING, _ = PHASES
VARIANTS: dict[str, dict[str, float]] = {
    "CPU": {},
    "GPU for learning": {"gpus": 1},
    "GPU for both": {"gpus": 0.5, "runner_gpus": 0.5},
}
WIDE = {"hidden": [1024, 1024], "train_batch_size": 16_384, "minibatch_size": 4096}
PARTS: dict[str, tuple[str, dict[str, Any]]] = {
    "pistonball_gpu": ("pistonball_gpu", {}),
    "connect_four": ("connect_four", {"opponents": [], "teacher": None}),
    "connect_four, 1,024 units": ("connect_four", {"opponents": [], "teacher": None, **WIDE}),
    "connect_four, LSTM": ("connect_four", {"opponents": [], "teacher": None, "recurrence": {"width": 128}}),
    "connect_four_dqn": ("connect_four_dqn", {"opponents": [], "learning_starts": 1000}),
    "simple_spread_qmix": ("simple_spread_qmix", {"learning_starts": 1000}),
    "simple_adversary": ("simple_adversary", {"learning_starts": 1000}),
}


@dataclass(frozen=True, slots=True)
class Cost:
    """Seconds per 1,000 actions of all agents."""

    sampling: float
    learning: float
    total: float


def cost(league: LeagueConfig, seconds: float) -> Cost:
    """Train for some seconds after the first updates, which include compilation and the filling of a replay buffer."""
    algorithm = build_algorithm(league, interface(league))
    try:
        began = time.perf_counter()
        while time.perf_counter() - began < seconds / 3:
            algorithm.train()
        sums, thousands, began = Counter[str](), 0.0, time.perf_counter()
        while (elapsed := time.perf_counter() - began) < seconds:
            result = algorithm.train()
            sums.update(totals(result))
            thousands += result[ENV_RUNNER_RESULTS][NUM_ENV_STEPS_SAMPLED] / 1000
        return Cost(sums[SAMPLING] / thousands, sums[LEARNING] / thousands, elapsed / thousands)
    finally:
        algorithm.stop()


def measure(part: str, seconds: float) -> Iterator[Target]:
    """Measure each variant of one configuration."""
    name, settings = PARTS[part]
    league = LeagueConfig.load(CONFIGS / f"{name}.yaml").with_training(**settings, runners=0)
    costs = {variant: cost(league.with_training(**gpus), seconds) for variant, gpus in VARIANTS.items()}
    for variant, seconds_per_thousand in costs.items():
        ratio = seconds_per_thousand.total / costs["CPU"].total
        note = f"sampling {seconds_per_thousand.sampling:.3f} s, learning {seconds_per_thousand.learning:.3f} s"
        yield Target(f"{part}, {variant}", round(ratio, 2), "×", note=note)


def main(parts: Parts = None, quick: Quick = False) -> Iterator[Target]:
    """Measure the configurations; without a GPU, nothing is measured."""
    if not torch.cuda.is_available():
        print("skipped: torch finds no GPU")
        return
    torch.set_num_threads(MAX_THREADS)
    print(f"{torch.cuda.get_device_name()}, {torch.get_num_threads()} threads, torch {torch.__version__}")
    with local_ray(cpus=2):
        for part in chosen(parts, PARTS):
            yield from measure(part, 2.0 if quick else 8.0)
