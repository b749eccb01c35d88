"""Connect four with opponents from the league, compared with self-play alone.

Both arms of a seed train at the same time, each on one core and in a registry of its own, so that they have equal wall
time on the same machine.
"""

import io
import math
import shutil
import statistics
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from benchmarks.harness import CONFIGS, Target
from benchmarks.training.learned import in_processes, one_thread
from evaluation.documents import ExploiterScore
from evaluation.gating.criteria.exploitability import exploitability
from evaluation.matches.worker import MatchWorker
from evaluation.schedules.builders import gauntlet
from evaluation.statistics.payoff import score_interval
from league.config.league import LeagueConfig
from league.environments.building import interface
from league.ray_cluster import LocalRay
from league.refs import CheckpointRef
from league.registry.registry import Registry
from league.registry.storage.manifest import Manifest
from league.settings import Storage
from training.runs.train import train

CONFIG = CONFIGS / "connect_four.yaml"
SEEDS = range(3)
MINUTES = 28.0
"""Of training, by default."""
VERSIONS, BLOCKS = 7, 200
EXPLOITER = 0.15
"""Share of the budget for the exploiter of the last version."""
GAIN = 0.10
"""By how much the lowest score against own past versions must be higher."""
INFERIOR = -50.0
"""Elo below which a policy is inferior."""
SELF_PLAY, LEAGUE = "self-play", "league"
ONE_CORE = LocalRay(cpus=1)


@dataclass(frozen=True, slots=True)
class ArmJob:
    """A training to be done, and the home of its registry."""

    name: str
    seed: int
    minutes: float
    home: Path


@dataclass(frozen=True, slots=True)
class Arm:
    """A training: its last version and the actions until it, its lowest score against an earlier version of the
    same training, and the score of its exploiter."""

    last: str
    steps: int
    lowest: float
    exploiter: ExploiterScore


def compare_arms(minutes: float, seeds: Sequence[int] = SEEDS) -> Iterator[Target]:
    """Train and measure both arms with all seeds. minutes: of each training."""
    arms: dict[str, list[Arm]] = {SELF_PLAY: [], LEAGUE: []}
    scores: list[float] = []
    for seed in seeds:
        with tempfile.TemporaryDirectory() as home:
            jobs = [ArmJob(name, seed, minutes, Path(home) / name) for name in (LEAGUE, SELF_PLAY)]
            for job, arm in zip(jobs, in_processes(work, jobs), strict=True):
                arms[job.name].append(arm)
                best = arm.exploiter
                note = f"{arm.steps:,} actions; exploiter {best.score:.3f} [{best.low:.3f}, {best.high:.3f}]"
                name = f"connect_four, lowest score against its past, {job.name}, seed {seed}"
                yield Target(name, round(arm.lowest, 3), note=note)
            scores += _between(jobs, [arms[job.name][-1].last for job in jobs])
    past, exploited = (
        {name: statistics.mean(map(value, results)) for name, results in arms.items()}
        for value in (lambda arm: arm.lowest, lambda arm: arm.exploiter.score)
    )
    score, low, high = map(elo, score_interval(scores))
    gain = round(past[LEAGUE] - past[SELF_PLAY], 3)
    yield Target("connect_four, gain of the lowest score against its past", gain, at_least=GAIN)
    name, limit = "connect_four, score of the exploiters", round(exploited[SELF_PLAY], 3)
    yield Target(name, round(exploited[LEAGUE], 3), at_most=limit, peer=SELF_PLAY)
    note = f"{score:+.0f} Elo, at most {high:+.0f}"
    yield Target("connect_four, strength, lower bound", round(low), "Elo", INFERIOR, peer=SELF_PLAY, note=note)


def work(job: ArmJob) -> Arm:
    """Train an arm on the single core of this process."""
    one_thread()
    with closing(Registry.open(Storage.at(job.home))) as registry:
        return train_arm(registry, _config(job.name, job.seed, job.minutes))


def _between(jobs: Sequence[ArmJob], refs: Sequence[str]) -> list[float]:
    """Play the last version of the first arm against that of the second; return its scores."""
    with ExitStack() as stack:
        registry, other = (stack.enter_context(closing(Registry.open(Storage.at(job.home)))) for job in jobs)
        row = other.versions.resolve(CheckpointRef.parse(refs[1]))

        def build(directory: Path, number: int) -> Manifest:
            shutil.copytree(other.artifacts.path(row.league, row.number), directory, dirs_exist_ok=True)
            return row.manifest.model_copy(update={"version": number, "parent": None})

        opponent = registry.publisher.publish(row.league, build, source="self-play")
        config = _config(jobs[0].name, jobs[0].seed, jobs[0].minutes)
        return _scores(registry, config, refs[0], [opponent.ref])[0]


def train_arm(registry: Registry, config: LeagueConfig) -> Arm:
    """Train, play the last version against the earlier ones, and train and play its exploiter."""
    quiet = Console(file=io.StringIO())
    versions = train(config, registry=registry, console=quiet, local=ONE_CORE)
    last, target = versions[-1], CheckpointRef(config.league, versions[-1].number)
    lowest = min(map(statistics.mean, _scores(registry, config, last.ref, [version.ref for version in versions[:-1]])))
    settings = config.of_exploiter(config.training.seed, None, config.training.minutes, EXPLOITER)
    train(settings, registry=registry, parent=target, role="exploiter", target=target, console=quiet, local=ONE_CORE)
    score = exploitability(target, registry=registry, blocks=BLOCKS)
    return Arm(last.ref, last.steps, lowest, score.exploiters[0])


def elo(score: float) -> float:
    """Return the difference in Elo of an expected score."""
    return -math.inf if score <= 0 else math.inf if score >= 1 else 400 * math.log10(score / (1 - score))


def _config(arm: str, seed: int, minutes: float) -> LeagueConfig:
    """Return the configuration of an arm. Both have the fixed opponents of a night."""
    config = LeagueConfig.load(CONFIG)
    assert config.nightly.opponents is not None
    opponents = config.nightly.opponents.model_dump(by_alias=True)
    if arm == SELF_PLAY:
        opponents["league"] = None
    return config.with_training(
        runners=0, seed=seed, minutes=minutes, checkpoint_minutes=minutes / VERSIONS, opponents=opponents, strength=None
    )


def _scores(registry: Registry, config: LeagueConfig, version: str, opponents: list[str]) -> list[list[float]]:
    """Play a version against others, without recording the matches; return its scores against each one."""
    schedule = gauntlet(config, interface(config), [version], opponents, BLOCKS)
    scores: dict[str, list[float]] = {ref: [] for ref in opponents}
    for match in MatchWorker(config, registry).play(schedule, range(schedule.length)):
        number = match.contestants.index(version)
        scores[match.contestants[1 - number]].append(match.score(number))
    return list(scores.values())
