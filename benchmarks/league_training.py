"""What do opponents from the league cost, and what do they buy?

- overhead: time per action of connect four with opponents from the league, compared with self-play; they alternate.
- blotto: the exact exploitability of Colonel Blotto's policies by the distribution of opponents, for several seeds with
  equal numbers of actions. `last` is the last version; `nash` the equilibrium of all versions, and `average` the last
  half of them with equal probabilities: mixtures that an alias can serve. Versions are published only for arms that
  draw opponents from them.
- connect_four: strength, lowest score against own past versions, and learned exploitability with opponents from the
  league and in self-play alone, after 28 minutes on one core with each of three seeds: about two hours on two cores.
  `--minutes` and `--seeds` measure less.
"""

import argparse
import io
import math
import statistics
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from ray.rllib.algorithms.algorithm import Algorithm
from ray.rllib.core.columns import Columns
from ray.rllib.utils.metrics import ENV_RUNNER_RESULTS, NUM_ENV_STEPS_SAMPLED
from rich.console import Console

from benchmarks.training.league_arms import MINUTES, compare_arms
from benchmarks.training.league_arms import SEEDS as CONNECT_FOUR_SEEDS
from benchmarks.training.learned import local_ray, one_thread, report_target, updates
from league.config.league import LeagueConfig
from league.environments.building import interface
from league.registry.registry import Registry
from league.results.equilibria import nash_averaging
from league.settings import Storage
from league.spaces import OBSERVATION
from policy_league.examples.blotto import PAYOFF, exploitability
from training.algorithms.league_algorithm import LeagueAlgorithm
from training.algorithms.metrics import totals
from training.export.publish import Checkpoint, publish
from training.runs.train import train
from training.runs.trial import build_algorithm

CONFIGS = Path(__file__).parent.parent / "policy_league/configs"
OVERHEAD = 1.3
"""Maximum ratio of the times per action."""
SEEDS = range(5)
ARMS: dict[str, dict[str, Any]] = {
    "self-play": {},
    "magnet": {"magnet": {"ref": "previous", "every": 10, "weight": 0.3}},
    "uniform magnet": {"magnet": {"ref": "uniform", "weight": 0.1}},
    **{name: {"opponents": {"league": {"sampling": name, "window": 50}}} for name in ("nash", "pfsp", "uniform")},
}
"""Settings of training in which the arms differ."""
LESS_EXPLOITABLE = {"nash": "nash", "magnet": "last", "uniform magnet": "last"}
"""Arms that must be less exploitable than a third of self-play's last version, and what is compared of them."""
BLOTTO = {
    "league": "blotto",
    "environment": {
        "entry_point": "policy_league.examples.blotto:env",
        "vector": "policy_league.examples.blotto_vector:BlottoVector",
    },
}
VERSIONS = 25
"""Versions of each training of Blotto."""
BLOTTO_TRAINING = {"runners": 0, "hidden": [32], "train_batch_size": 2048, "lr": 0.003, "entropy": 0.01, "gamma": 1.0}
"""Of all arms. At the default rate, a million actions do not make self-play exploitable."""


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
    met = True
    for arm, settings in ARMS.items():
        found: dict[str, list[float]] = {"last": [], "nash": [], "average": []}
        for seed in SEEDS:
            policies = trained(settings, seed, steps)
            payoff = policies @ PAYOFF @ policies.T
            found["last"].append(exploitability(policies[-1]))
            found["nash"].append(exploitability(nash_averaging(payoff)[0] @ policies))
            found["average"].append(exploitability(policies[len(policies) // 2 :].mean(axis=0)))
        for name, values in found.items():
            means[arm, name] = statistics.mean(values)
            print(f"blotto, {arm}, {name}: {means[arm, name]:.3f} ({_each(values)})", flush=True)
        if arm in LESS_EXPLOITABLE:
            kind = LESS_EXPLOITABLE[arm]
            mean, third = means[arm, kind], means["self-play", "last"] / 3
            met &= report_target(f"blotto, {arm}, {kind}: {mean:.3f}", f"{third:.3f}", mean <= third)
    return met


def trained(settings: dict[str, Any], seed: int, steps: int) -> NDArray[np.float64]:
    """Train a league of Blotto; return the action probabilities of all versions, (versions, actions).

    Trains in this process as a trial of `league train` does. A version becomes a candidate at the next checkpoint.
    """
    config = LeagueConfig.from_mapping(
        BLOTTO | {"training": BLOTTO_TRAINING | {"steps": steps, "seed": seed} | settings}
    )
    spaces = interface(config)
    with tempfile.TemporaryDirectory() as home, closing(Registry.open(Storage.at(Path(home)))) as registry:
        registry.leagues.register(config, spaces)
        algorithm = build_algorithm(config, spaces, storage=registry.storage)
        assert isinstance(algorithm, LeagueAlgorithm)
        policies: list[NDArray[np.float64]] = []
        try:
            algorithm.reset_episodes(0)
            for update in updates(algorithm, math.inf, steps):
                if update.steps * VERSIONS < steps * (len(policies) + 1):
                    continue
                policies.append(_probabilities(algorithm))
                if config.training.opponents.league is not None:
                    checkpoint = Checkpoint(Path(home) / f"{update.steps}", f"blotto/{update.steps}", update.steps)
                    algorithm.opponents.refresh(checkpoint=checkpoint.source)
                    algorithm.save_to_path(checkpoint.path)
                    publish(
                        checkpoint, registry=registry, config=config, interface=spaces, parent=None, git_commit=None
                    )
                algorithm.reset_episodes(update.steps)
        finally:
            algorithm.stop()
        return np.stack(policies)


def _probabilities(algorithm: LeagueAlgorithm) -> NDArray[np.float64]:
    module = algorithm.learner_group._learner.module["shared"]
    output = module.forward_inference({Columns.OBS: {OBSERVATION: torch.zeros(1, 1)}})
    return np.asarray(output[Columns.ACTION_DIST_INPUTS][0].double().softmax(-1))


def _each(values: Any) -> str:
    return ", ".join(f"{value:.3f}" for value in values)


def connect_four(quick: bool, minutes: float = MINUTES, seeds: Sequence[int] = CONNECT_FOUR_SEEDS) -> bool:
    """Compare both arms after a budget for each; see `compare_arms`."""
    return compare_arms(minutes / 10 if quick else minutes, seeds)


PARTS = {"overhead": overhead, "blotto": blotto, "connect_four": connect_four}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the requested parts; 1 if a target is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"some of {', '.join(PARTS)}; default: all")
    parser.add_argument("--quick", action="store_true", help="a tenth of the time")
    parser.add_argument("--minutes", type=float, default=MINUTES, help="of an arm of connect_four; default: 28")
    parser.add_argument("--seeds", type=int, nargs="+", default=CONNECT_FOUR_SEEDS, help="of connect_four")
    given = parser.parse_args(arguments)
    if unknown := [part for part in given.parts if part not in PARTS]:
        parser.error(f"no part {', '.join(unknown)}: expected some of {', '.join(PARTS)}")
    parts = PARTS | {"connect_four": partial(connect_four, minutes=given.minutes, seeds=given.seeds)}
    one_thread()
    with local_ray(cpus=2):
        missed = [name for name in given.parts or parts if not parts[name](given.quick)]
    print(f"\nmissed: {', '.join(missed)}" if missed else "\nall met")
    return bool(missed)


if __name__ == "__main__":
    sys.exit(main())
