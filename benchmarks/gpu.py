"""What does a GPU save in training? Run on a machine with one: learner, and learner and sampling, against the CPU.

For each configuration: seconds of sampling and of learning per 1,000 actions, and the time in total relative to that of
the CPU. All is done in one process, with four threads, after the first updates.
"""

import argparse
import sys
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from ray.rllib.utils.metrics import ENV_RUNNER_RESULTS, NUM_ENV_STEPS_SAMPLED

from benchmarks.training.learned import local_ray
from league.config.league import LeagueConfig
from league.environments.building import interface
from training.algorithms.metrics import PHASES, totals
from training.runs.trial import MAX_THREADS, build_algorithm

CONFIGS = Path(__file__).parent.parent / "policy_league/configs"
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
        begun = time.perf_counter()
        while time.perf_counter() - begun < seconds / 3:
            algorithm.train()
        sums, thousands, begun = Counter[str](), 0.0, time.perf_counter()
        while (elapsed := time.perf_counter() - begun) < seconds:
            result = algorithm.train()
            sums.update(totals(result))
            thousands += result[ENV_RUNNER_RESULTS][NUM_ENV_STEPS_SAMPLED] / 1000
        return Cost(sums[SAMPLING] / thousands, sums[LEARNING] / thousands, elapsed / thousands)
    finally:
        algorithm.stop()


def measure(part: str, seconds: float) -> None:
    """Print the row of each variant of one configuration, with its ratio to the CPU."""
    name, settings = PARTS[part]
    league = LeagueConfig.load(CONFIGS / f"{name}.yaml").with_training(**settings, runners=0)
    costs = {variant: cost(league.with_training(**gpus), seconds) for variant, gpus in VARIANTS.items()}
    for variant, found in costs.items():
        ratio = found.total / costs["CPU"].total
        print(f"| {part} | {variant} | {found.sampling:.3f} | {found.learning:.3f} | {ratio:.2f}× |", flush=True)


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure the requested configurations; without a GPU, nothing is measured."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"some of {', '.join(PARTS)}; default: all")
    parser.add_argument("--quick", action="store_true", help="a few seconds each")
    given = parser.parse_args(arguments)
    if unknown := [part for part in given.parts if part not in PARTS]:
        parser.error(f"no part {', '.join(unknown)}: expected some of {', '.join(PARTS)}")
    if not torch.cuda.is_available():
        print("skipped: torch finds no GPU")
        return 0
    torch.set_num_threads(MAX_THREADS)
    print(f"{torch.cuda.get_device_name()}, {torch.get_num_threads()} threads, torch {torch.__version__}")
    print("| configuration | variant | sampling | learning | time |")
    with local_ray(cpus=2):
        for part in given.parts or PARTS:
            measure(part, 2.0 if given.quick else 8.0)
    return 0


if __name__ == "__main__":
    sys.exit(main())
