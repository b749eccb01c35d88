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

import io
import math
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer
from numpy.typing import NDArray
from ray.rllib.algorithms.algorithm import Algorithm
from ray.rllib.core.columns import Columns
from ray.rllib.utils.metrics import ENV_RUNNER_RESULTS, NUM_ENV_STEPS_SAMPLED
from rich.console import Console

from benchmarks.harness import CONFIGS, Parts, Quick, Target, chosen
from benchmarks.optimal_play import blotto_exploitability
from benchmarks.training.league_arms import MINUTES, compare_arms
from benchmarks.training.league_arms import SEEDS as CONNECT_FOUR_SEEDS
from benchmarks.training.learned import local_ray, one_thread, updates
from league.config.league import LeagueConfig
from league.environments.building import interface
from league.registry.registry import Registry
from league.results.equilibria import nash_averaging
from league.settings import Storage
from league.spaces import OBSERVATION
from policy_league.examples.blotto import PAYOFF
from training.algorithms.league_algorithm import LeagueAlgorithm
from training.algorithms.metrics import totals
from training.export.publish import Checkpoint, publish
from training.runs.train import train
from training.runs.trial import build_algorithm

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


def overhead(quick: bool) -> Iterator[Target]:
    """The times per action with both kinds of opponents."""
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
    medians = {name: [statistics.median(column) for column in zip(*rows, strict=True)] for name, rows in times.items()}
    for part, alone, league in zip(("overhead", "overhead of sampling"), *medians.values(), strict=True):
        note = f"{league:.1f} to {alone:.1f} µs per action"
        yield Target(part, round(league / alone, 2), "×", at_most=OVERHEAD, peer="self-play", note=note)


def update_times(algorithm: Algorithm, updates: int) -> tuple[float, float]:
    """Microseconds per action of some updates: wall time, and that of sampling."""
    began, actions, sampling = time.perf_counter(), 0, 0.0
    for _ in range(updates):
        result = algorithm.train()
        actions += int(result[ENV_RUNNER_RESULTS][NUM_ENV_STEPS_SAMPLED])
        sampling += totals(result)["time/sampling"]
    return 1e6 * (time.perf_counter() - began) / actions, 1e6 * sampling / actions


def blotto(quick: bool) -> Iterator[Target]:
    """The exploitability of all arms and seeds."""
    third = math.inf
    for arm, settings in ARMS.items():
        values: dict[str, list[float]] = {"last": [], "nash": [], "average": []}
        for seed in SEEDS:
            policies = trained(settings, seed, 100_000 if quick else 1_000_000)
            payoff = policies @ PAYOFF @ policies.T
            values["last"].append(blotto_exploitability(policies[-1]))
            values["nash"].append(blotto_exploitability(nash_averaging(payoff)[0] @ policies))
            values["average"].append(blotto_exploitability(policies[len(policies) // 2 :].mean(axis=0)))
        for kind, of_seeds in values.items():
            mean = round(statistics.mean(of_seeds), 3)
            if (arm, kind) == ("self-play", "last"):
                third = mean / 3
            limit = round(third, 3) if LESS_EXPLOITABLE.get(arm) == kind else None
            note = ", ".join(f"{value:.3f}" for value in of_seeds)
            yield Target(f"blotto, {arm}, {kind}", mean, at_most=limit, note=note)


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


def main(
    parts: Parts = None,
    quick: Quick = False,
    minutes: Annotated[float, typer.Option(help="of an arm of connect_four")] = MINUTES,
    seeds: Annotated[list[int] | None, typer.Option(help="of connect_four; default: 0, 1, 2")] = None,
) -> Iterator[Target]:
    """Measure the parts."""
    cases: dict[str, Callable[[], Iterator[Target]]] = {
        "overhead": lambda: overhead(quick),
        "blotto": lambda: blotto(quick),
        "connect_four": lambda: compare_arms(minutes / 10 if quick else minutes, seeds or CONNECT_FOUR_SEEDS),
    }
    one_thread()
    with local_ray(cpus=2):
        for part in chosen(parts, cases).values():
            yield from part()
