"""What do opponents from the league cost, and what do they buy?

- overhead: time per action of connect four with opponents from the league, compared with self-play; they alternate.
- blotto: the exact exploitability of Colonel Blotto's policies by the distribution of opponents, for several seeds with
  equal numbers of actions. `last` is the last published version, and `nash` the equilibrium of all published versions,
  an upper bound of what a mixture of them can reach.
"""

import argparse
import io
import statistics
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from ray.rllib.algorithms.algorithm import Algorithm
from ray.rllib.utils.metrics import ENV_RUNNER_RESULTS, NUM_ENV_STEPS_SAMPLED
from rich.console import Console
from scipy.special import softmax

from benchmarks.training.learned import local_ray, one_thread, report_target
from examples.blotto import PAYOFF, exploitability
from league.config.league import LeagueConfig
from league.environments.building import interface
from league.policies.loading import load
from league.policies.onnx import OnnxPolicy
from league.registry.registry import Registry
from league.results.equilibria import nash_averaging
from league.settings import Storage
from training.algorithms.league_algorithm import LeagueAlgorithm
from training.algorithms.metrics import totals
from training.runs.train import train
from training.runs.trial import build_algorithm

CONFIGS = Path(__file__).parent.parent / "configs"
OVERHEAD = 1.3
"""Maximum ratio of the times per action."""
SEEDS = range(5)
ARMS: dict[str, dict[str, Any]] = {
    "self-play": {},
    **{name: {"opponents": {"league": {"sampling": name, "window": 50}}} for name in ("uniform", "pfsp", "nash")},
    "magnet": {"magnet": {"ref": "previous", "every": 10, "weight": 0.3}, "entropy": 0.0},
}
"""Settings of training in which the arms differ."""
LESS_EXPLOITABLE = {"nash": "nash", "magnet": "last"}
"""Arms that must be less exploitable than a third of self-play's last version, and what is compared of them."""
BLOTTO = {
    "league": "blotto",
    "environment": {"entry_point": "examples.blotto:env", "vector": "examples.blotto_vector:BlottoVector"},
}
BLOTTO_TRAINING = {"runners": 0, "hidden": [32], "train_batch_size": 2048, "entropy": 0.02, "gamma": 1.0}


def overhead(quick: bool) -> bool:
    """Print the times per action with both kinds of opponents."""
    versions, rounds, updates = (4, 3, 4) if quick else (8, 7, 10)
    config = LeagueConfig.load(CONFIGS / "connect_four.yaml")
    config = config.with_training(runners=0, minutes=None, steps=4096 * versions, checkpoint_every=4096)
    with tempfile.TemporaryDirectory() as home, closing(Registry.open(Storage.at(Path(home)))) as registry:
        train(config, registry=registry, console=Console(file=io.StringIO()))
        arms = {
            name: build_algorithm(
                config.with_training(opponents=opponents), interface(config), storage=registry.storage
            )
            for name, opponents in {"self-play": [], "league": {"league": {}}}.items()
        }
        for algorithm in arms.values():
            assert isinstance(algorithm, LeagueAlgorithm)
            algorithm.opponents.refresh()
            algorithm.reset_episodes(0)
            algorithm.train()
        times: dict[str, list[tuple[float, float]]] = {name: [] for name in arms}
        for _ in range(rounds):
            for name, algorithm in arms.items():
                times[name].append(update_times(algorithm, updates))
        for algorithm in arms.values():
            algorithm.stop()
    met = True
    for number, part in enumerate(("sampling and learning", "sampling alone")):
        own, league = (statistics.median(each[number] for each in times[name]) for name in ("self-play", "league"))
        print(f"overhead, {part}: {own:.1f} µs per action in self-play, {league:.1f} µs with opponents")
        met &= report_target(f"overhead, {part}: {league / own:.2f}×", f"{OVERHEAD}×", league <= OVERHEAD * own)
    return met


def update_times(algorithm: Algorithm, updates: int) -> tuple[float, float]:
    """Microseconds per action of some updates: wall time, and that of sampling."""
    began, actions, sampling = time.perf_counter(), 0, 0.0
    for _ in range(updates):
        result = algorithm.train()
        actions += int(result[ENV_RUNNER_RESULTS][NUM_ENV_STEPS_SAMPLED])
        sampling += totals(result)["time/sampling"]
    return 1e6 * (time.perf_counter() - began) / actions, 1e6 * sampling / actions


def blotto(quick: bool) -> bool:
    """Print the exploitability of all arms and seeds."""
    steps = 100_000 if quick else 1_000_000
    means: dict[tuple[str, str], float] = {}
    for arm, settings in ARMS.items():
        found: dict[str, list[float]] = {"last": [], "nash": []}
        for seed in SEEDS:
            policies = published(settings, seed, steps)
            payoff = policies @ PAYOFF @ policies.T
            found["last"].append(exploitability(policies[-1]))
            found["nash"].append(exploitability(nash_averaging(payoff)[0] @ policies))
        for name, values in found.items():
            means[arm, name] = statistics.mean(values)
            print(f"blotto, {arm}, {name}: {means[arm, name]:.3f} ({_each(values)})", flush=True)
    third = means["self-play", "last"] / 3
    met = True
    for compared in LESS_EXPLOITABLE.items():
        found = means[compared]
        met &= report_target(f"blotto, {', '.join(compared)}: {found:.3f}", f"{third:.3f}", found <= third)
    return met


def published(settings: dict[str, Any], seed: int, steps: int) -> NDArray[np.float64]:
    """Train a league of Blotto; return the action probabilities of all versions, (versions, actions)."""
    training = BLOTTO_TRAINING | {"steps": steps, "checkpoint_every": steps // 25, "seed": seed} | settings
    config = LeagueConfig.from_mapping(BLOTTO | {"training": training})
    with tempfile.TemporaryDirectory() as home, closing(Registry.open(Storage.at(Path(home)))) as registry:
        versions = train(config, registry=registry, console=Console(file=io.StringIO()))
        return np.stack([_probabilities(version.ref, registry) for version in versions])


def _probabilities(ref: str, registry: Registry) -> NDArray[np.float64]:
    policy = load(ref, registry=registry)
    assert isinstance(policy, OnnxPolicy)
    inputs = policy.distribution({"observation": np.zeros((1, 1), np.float32)}).dist_inputs
    assert inputs is not None
    return np.asarray(softmax(inputs[0].astype(np.float64)))


def _each(values: Any) -> str:
    return ", ".join(f"{value:.3f}" for value in values)


PARTS = {"overhead": overhead, "blotto": blotto}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the requested parts; 1 if a target is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"some of {', '.join(PARTS)}; default: all")
    parser.add_argument("--quick", action="store_true", help="a tenth of the time")
    given = parser.parse_args(arguments)
    if unknown := [part for part in given.parts if part not in PARTS]:
        parser.error(f"no part {', '.join(unknown)}: expected some of {', '.join(PARTS)}")
    one_thread()
    with local_ray(cpus=2):
        missed = [name for name in given.parts or PARTS if not PARTS[name](given.quick)]
    print(f"\nmissed: {', '.join(missed)}" if missed else "\nall met")
    return bool(missed)


if __name__ == "__main__":
    sys.exit(main())
