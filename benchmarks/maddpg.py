"""MADDPG compared with independent DDPG in simple_adversary: which one deceives better?

Both are trained for the same CPU time, so that other load on the machine does not affect the comparison; each seed in a
process with one core, two at a time. Then each adversary plays each good side, greedily, from the same initial states.
A finished seed is not trained again: its policies are kept in `--directory`. All seeds are printed. Returns are per
agent and episode.
"""

import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from ray.rllib.env.single_agent_episode import SingleAgentEpisode
from ray.rllib.utils.metrics import ENV_RUNNER_RESULTS, EPISODE_MODULE_RETURN_MEAN
from scipy import stats

from benchmarks.harness import CONFIGS, Quick, Target
from benchmarks.training.learned import in_processes, local_ray, one_thread
from league.config.league import LeagueConfig
from league.environments.building import interface
from training.algorithms.maddpg import MADDPG
from training.algorithms.rllib_config import algorithm_config
from training.runs.trial import build_algorithm
from training.sampling.replay_runner import ActorRunner

CONFIG = CONFIGS / "simple_adversary.yaml"
CRITICS = {"MADDPG": "centralised", "DDPG": "own"}
ADVERSARY, GOOD = "adversary", "good_0"
"""Policies of the two sides; the two good agents have equal rewards."""
AGENTS = 3
BAND = "MAPPO of MARLlib after 20M steps: good agent +8.0 … +10.6, adversary −14.9 … −17.1"
POINTS = 10
"""Number of points of the printed curve."""


@dataclass(frozen=True, slots=True)
class TrainingJob:
    """One training."""

    critic: str
    seed: int
    minutes: float
    directory: Path

    @property
    def file(self) -> Path:
        return self.directory / f"{self.critic}-{self.seed}-{self.minutes:g}min.npz"


@dataclass(frozen=True, slots=True)
class Trained:
    """weights: policy id → name → array. summary: measurements of `train`."""

    weights: dict[str, dict[str, NDArray]]
    summary: dict[str, Any]

    @classmethod
    def load(cls, file: Path) -> "Trained":
        weights: dict[str, dict[str, NDArray]] = {}
        with np.load(file, allow_pickle=False) as kept:
            for key in kept.files:
                if key != "summary":
                    policy, _, name = key.partition("/")
                    weights.setdefault(policy, {})[name] = kept[key]
            return cls(weights, json.loads(str(kept["summary"])))


def league_of(critic: str, **settings: Any) -> LeagueConfig:
    """The shipped configuration, sampling in the learner's process."""
    return LeagueConfig.load(CONFIG).with_training(critic=critic, runners=0, **settings)


def train(job: TrainingJob) -> None:
    """Learn for this number of CPU minutes on one core, and save the actors."""
    if job.file.exists():
        return
    one_thread()
    league = league_of(job.critic, seed=job.seed)
    with local_ray(cpus=1):
        algorithm = build_algorithm(league, interface(league))
        assert isinstance(algorithm, MADDPG)
        algorithm.reset_episodes(0)
        curve = learning_curve(algorithm, 60 * job.minutes)
        weights = {
            f"{policy}/{name}": array
            for policy, module in algorithm.learner_group._learner.module.items()
            for name, array in module.get_state().items()
        }
        algorithm.stop()
    summary = {"curve": curve, "steps": curve[-1]["steps"], "seconds": curve[-1]["seconds"]}
    job.directory.mkdir(parents=True, exist_ok=True)
    draft = job.file.with_suffix(".part.npz")
    np.savez(draft, summary=np.array(json.dumps(summary)), **weights)
    draft.rename(job.file)


def learning_curve(algorithm: MADDPG, seconds: float) -> list[dict[str, float]]:
    """Train for this number of CPU seconds. Returns POINTS of the curve, each with the mean returns since the previous
    one.
    """
    curve: list[dict[str, float]] = []
    returns: dict[str, list[float]] = {ADVERSARY: [], GOOD: []}
    began = time.process_time()
    while (spent := time.process_time() - began) < seconds or not curve:
        means = algorithm.train()[ENV_RUNNER_RESULTS].get(EPISODE_MODULE_RETURN_MEAN, {})
        for policy, values in returns.items():
            values.append(float(means.get(policy, np.nan)))
        spent = time.process_time() - began
        if spent >= seconds * (len(curve) + 1) / POINTS:
            point = {policy: float(np.nanmean(values)) for policy, values in returns.items()}
            curve.append(point | {"steps": algorithm.steps, "seconds": spent})
            returns = {policy: [] for policy in returns}
    return curve


def main(
    quick: Quick = False,
    minutes: Annotated[float, typer.Option(help="of each training")] = 20.0,
    seeds: Annotated[int, typer.Option(help="of each algorithm")] = 5,
    episodes: Annotated[int, typer.Option(help="of each pair in cross-play")] = 400,
    directory: Annotated[Path, typer.Option(help="of trained policies")] = Path("build/benchmarks/maddpg"),
) -> Iterator[Target]:
    """Train, and play the adversaries of each algorithm against the good sides of each: four cells."""
    if quick:
        minutes, seeds, episodes = 0.5, 2, 50
    jobs = {
        name: [TrainingJob(critic, seed, minutes, directory) for seed in range(seeds)]
        for name, critic in CRITICS.items()
    }
    # Seeds of both algorithms run side by side, so that both have the same share of the machine.
    list(in_processes(train, [job for pair in zip(*jobs.values(), strict=True) for job in pair]))
    trained = {name: [Trained.load(job.file) for job in of_algorithm] for name, of_algorithm in jobs.items()}
    for name, versions in trained.items():
        for seed, version in enumerate(versions):
            print_seed(name, seed, version)
    with local_ray(cpus=1):
        one_thread()
        cells, random = matrix(trained, episodes)
    print(f"all at random: good agent {random[1]:.2f}, adversary {random[0]:.2f}. {BAND}")
    yield from compare(cells)


Cells = dict[tuple[str, str], NDArray]
"""(algorithm of the adversary, of the good side) → mean returns of adversary and good agent, (adversary seeds, good
seeds, 2).
"""


def matrix(trained: dict[str, list[Trained]], episodes: int) -> tuple[Cells, tuple[float, float]]:
    """Each adversary against each good side, for the same number of episodes from the same initial states; and the
    returns of random play.
    """
    league = league_of("centralised", seed=10_000)
    described = interface(league)
    runner = ActorRunner(config=algorithm_config(league, described), worker_index=0)
    random = means(runner.sample(num_episodes=10 * episodes, random_actions=True))
    cells: Cells = {}
    for name, adversaries in trained.items():
        for of_good, goods in trained.items():
            pairs = [[play(runner, left, right, episodes) for right in goods] for left in adversaries]
            cells[name, of_good] = np.array(pairs)
    runner.stop()
    return cells, random


def play(runner: ActorRunner, adversary: Trained, good: Trained, episodes: int) -> tuple[float, float]:
    """Mean returns of the adversary and of a good agent, with greedy actions."""
    for policy, module in runner.module.items():
        module.set_state((adversary if policy == ADVERSARY else good).weights[policy])
    runner.reset_episodes(0)
    return means(runner.sample(num_episodes=episodes, explore=False))


def means(chunks: Sequence[SingleAgentEpisode]) -> tuple[float, float]:
    """Mean returns of the adversary and of a good agent in complete episodes."""
    complete = [chunk for chunk in chunks if chunk.is_done and chunk.t_started == 0]
    adversary, good = (
        float(np.mean([chunk.get_return() for chunk in complete if chunk.module_id == policy]))
        for policy in (ADVERSARY, GOOD)
    )
    return adversary, good


def print_seed(name: str, seed: int, trained: Trained) -> None:
    summary = trained.summary
    rate = summary["steps"] / AGENTS / summary["seconds"]
    print(
        f"{name}, seed {seed}: {summary['steps'] // AGENTS:,} environment steps in {summary['seconds']:,.0f} s"
        f" of a core, {rate:,.0f}/s; returns in training of adversary and good agent:"
    )
    print("  " + "  ".join(f"{point[ADVERSARY]:.1f}/{point[GOOD]:+.1f}" for point in summary["curve"]))


def compare(cells: Cells) -> Iterator[Target]:
    """The cells, and the advantage of MADDPG's good side. Each seed counts once, by its mean over the others."""
    for (adversary, good), cell in cells.items():
        returns, against = cell[:, :, 1].mean(axis=0), cell[:, :, 0].mean(axis=1)
        name = f"good agent of {good} against adversaries of {adversary}"
        note = f"each {', '.join(f'{value:.2f}' for value in returns)}; adversary {format_mean(against)}"
        yield Target(name, round(float(returns.mean()), 2), note=note)
    for adversary in CRITICS:
        ours, theirs = (cells[adversary, good][:, :, 1].mean(axis=0) for good in CRITICS)
        low, high = difference(ours, theirs)
        note = f"{ours.mean() - theirs.mean():.2f}, at most {high:.2f}"
        name = f"advantage of MADDPG's good side, lower bound, adversaries of {adversary}"
        yield Target(name, round(low, 2), at_least=0.0, note=note)


def format_mean(values: NDArray) -> str:
    """A mean with its t-interval."""
    if len(values) < 2:
        return f"{values.mean():.2f}"
    half = stats.t.ppf(0.975, len(values) - 1) * stats.sem(values)
    return f"{values.mean():.2f} ({values.mean() - half:.2f} … {values.mean() + half:.2f})"


def difference(first: NDArray, second: NDArray) -> tuple[float, float]:
    """Welch's 95 % interval of the difference of two means; infinite for single values."""
    if len(first) < 2:
        return float("-inf"), float("inf")
    interval = stats.ttest_ind(first, second, equal_var=False).confidence_interval(0.95)
    return float(interval.low), float(interval.high)
