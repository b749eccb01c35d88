"""Does training grow with the machine: with 16 cores against 2 of them, and with a GPU?

A part trains as `league train` does, for at most four minutes, and writes a line of JSON and the exported graphs to
`--folder`. With `--train-only` it ends there, for a machine that is lent for minutes. A part whose line is in the
folder is not trained again: its games and best responses are played on any machine. Limits hold for 16 cores, and for a
GPU where the part uses one: otherwise, and with `--quick`, values are only reported.
"""

import json
import math
import os
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from statistics import mean
from typing import Annotated, Any

import torch
import typer

from benchmarks import phases
from benchmarks.harness import CONFIGS, ROOT, Parts, Quick, Target, chosen, machine
from benchmarks.training.learned import in_processes, local_ray
from benchmarks.training.matches import games, lower_bound
from benchmarks.training.pistonball import EPISODES, returns
from league.config.league import LeagueConfig
from league.environments.building import interface
from league.policies.onnx import OnnxPolicy
from league.ray_cluster import LocalRay
from league.registry.registry import Registry
from league.settings import Storage
from policy_league.cli.demo import TEACHER
from training.algorithms.resources import MAX_THREADS
from training.export.publish import git_commit
from training.runs.train import train
from training.runs.trial import build_algorithm

CORES, SEEDS = 16, (0, 1, 2)
GAMES, STRONG = 2000, 95.0
"""Games against a script, and the lower bound against `script:one_ply` whose time is measured, in percent."""
ALONE: dict[str, Any] = {"teacher": None, "opponents": []}
RESULTS = "results.jsonl"


@dataclass(frozen=True, slots=True)
class Machine:
    """What a part may use. cores: their numbers. gpu: its name; empty for none. scale: of all times."""

    cores: Sequence[int]
    gpu: str
    scale: float

    def __str__(self) -> str:
        return f"{len(self.cores)} cores, {self.gpu or 'no GPU'}"


@dataclass(frozen=True, slots=True)
class Job:
    """A training. cores: numbers of those that it uses. versions: number of published graphs."""

    name: str
    config: str
    minutes: float
    cores: Sequence[int]
    folder: Path
    settings: Mapping[str, Any] = field(default_factory=dict)
    versions: int = 1


@dataclass(frozen=True, slots=True)
class Trained:
    """rate: actions per second, without the first eighth of the time, in which programs are compiled. graphs: minutes
    of training → file. settings: those of the run, with all values that were chosen automatically."""

    rate: float
    graphs: Mapping[str, str]
    settings: Mapping[str, Any]


def run(job: Job) -> Trained:
    """Train on the cores of the job, in a process of its own, whose children inherit them."""
    os.sched_setaffinity(0, job.cores)
    settings = {"steps": None, "checkpoint_every": None, "strength": None, **job.settings}
    times = {"minutes": job.minutes, "checkpoint_minutes": job.minutes / job.versions}
    league = LeagueConfig.load(CONFIGS / f"{job.config}.yaml").with_training(**settings, **times)
    with tempfile.TemporaryDirectory() as home, closing(Registry.open(Storage.at(home))) as registry:
        graphs = {}
        for number, version in enumerate(train(league, registry=registry, local=LocalRay(len(job.cores))), 1):
            (policy,) = version.manifest.policies.values()
            graphs[f"{job.minutes * number / job.versions:.2f}"] = file = f"{job.name}-{number}.onnx".replace(" ", "_")
            (job.folder / file).write_bytes(registry.artifacts.read(version.manifest, policy.file))
        (record,) = registry.runs.newest(league.league)
        points = registry.runs.points(league.league, record.id)
        first, last = points[len(points) // 8], points[-1]
        seconds = (last.at - first.at).total_seconds()
        rate = (last.steps - first.steps) / seconds if seconds else record.steps / record.seconds
        return Trained(round(rate), graphs, record.settings)


@dataclass(frozen=True, slots=True)
class Result:
    """A line of the folder. lscpu: what that command prints. trained: by the name of the job. rates: actions per second
    of parts without trainings."""

    part: str
    commit: str
    machine: str
    place: Machine
    lscpu: str
    trained: Mapping[str, Trained]
    rates: Mapping[str, float]

    @classmethod
    def read(cls, line: str) -> "Result":
        """A result from its line."""
        fields = json.loads(line)
        trained = {name: Trained(**values) for name, values in fields["trained"].items()}
        return cls(**fields | {"trained": trained, "place": Machine(**fields["place"])})

    def lower_bounds(self, folder: Path, name: str, opponent: str) -> dict[float, float]:
        """Minutes of training → lower bound of the wins against a script, in percent."""
        league = LeagueConfig.load(CONFIGS / "connect_four.yaml")
        count = GAMES if self.place.scale == 1 else GAMES // 20
        return {
            float(minutes): round(lower_bound(games(OnnxPolicy(folder / file), league, opponent, count)), 2)
            for minutes, file in self.trained[name].graphs.items()
        }


Work = Callable[[Machine, Path], list[Job] | dict[str, float]]
Targets = Callable[[Result, Path], Iterator[Target]]


def cores_jobs(place: Machine, folder: Path) -> list[Job]:
    """As the demo trains. More cores have a third of the time."""
    few = place.cores[: 2 if len(place.cores) > 2 else 1]
    return [
        Job(f"{len(cores)}-core", "connect_four", minutes * place.scale, cores, folder, {"teacher": TEACHER}, versions)
        for cores, minutes, versions in ((few, 2.55, 4), (place.cores, 0.85, 3))
    ]


def cores_targets(result: Result, folder: Path) -> Iterator[Target]:
    few, many = result.trained
    ratio = result.trained[many].rate / result.trained[few].rate
    note = ", ".join(f"{name} {trained.rate:,.0f}/s" for name, trained in result.trained.items())
    yield Target(f"rate of the {many} run", ratio, "×", at_least=5.0, peer=f"the {few} run", note=note)
    bounds = {name: result.lower_bounds(folder, name, "script:one_ply") for name in result.trained}
    # If two cores do not get there, their time is longer than that of their last version.
    reached = {
        name: min((m for m, low in of.items() if low >= STRONG), default=math.inf) for name, of in bounds.items()
    }
    ratio = reached[many] / min(reached[few], max(bounds[few]))
    note = "; ".join(
        f"{name}: " + ", ".join(f"{m:g} min {low:g} %" for m, low in of.items()) for name, of in bounds.items()
    )
    yield Target(
        f"time to {STRONG:g} % against script:one_ply, {many} run",
        ratio,
        "×",
        at_most=1 / 3,
        peer=f"the {few} run",
        note=note,
    )


def gpu_jobs(place: Machine, folder: Path) -> list[Job]:
    """69 s each, of which the last 60 s count."""
    mlp = {**ALONE, "convolutions": [], "hidden": [256, 256]}
    return [
        Job(name, "connect_four", 1.15 * place.scale, place.cores, folder, settings | {"epochs": 4} | on_gpu(place))
        for name, settings in (("as shipped", {}), ("convolutions", ALONE), ("MLP", mlp))
    ]


def gpu_targets(result: Result, _: Path) -> Iterator[Target]:
    for (name, trained), limit in zip(result.trained.items(), (2e5, 4e5, 1e6), strict=True):
        yield Target(f"connect four, {name}", trained.rate, "/s", at_least=limit)


def strength_jobs(place: Machine, folder: Path) -> list[Job]:
    return [Job("strength", "connect_four", 2.5 * place.scale, place.cores, folder, on_gpu(place))]


def strength_targets(result: Result, folder: Path) -> Iterator[Target]:
    for opponent, limit in (("script:one_ply", 97.0), ("script:mcts_100", 78.0)):
        ((minutes, low),) = result.lower_bounds(folder, "strength", opponent).items()
        yield Target(f"after {minutes:g} minutes against {opponent}, lower bound", low, "%", at_least=limit)


def batches_jobs(place: Machine, folder: Path) -> list[Job]:
    """The same time with batches of different sizes: what a larger batch gains and costs."""
    return [
        Job(
            f"scale {scale}",
            "connect_four",
            0.75 * place.scale,
            place.cores,
            folder,
            on_gpu(place) | {"batch_scale": scale},
        )
        for scale in (4, 16, 64)
    ]


def batches_targets(result: Result, folder: Path) -> Iterator[Target]:
    for name, trained in result.trained.items():
        note = f"{trained.rate:,} actions/s"
        for opponent in ("script:one_ply", "script:mcts_100"):
            ((minutes, low),) = result.lower_bounds(folder, name, opponent).items()
            yield Target(f"{name}, after {minutes:g} minutes against {opponent}, lower bound", low, "%", note=note)


def leduc_jobs(place: Machine, folder: Path) -> list[Job]:
    """All seeds at once, each on its part of the cores."""
    at_once = min(len(SEEDS), len(place.cores))
    return [
        Job(
            f"leduc {seed}",
            "leduc_holdem",
            2 * place.scale,
            place.cores[seed % at_once :: at_once],
            folder,
            {"seed": seed},
        )
        for seed in SEEDS
    ]


def leduc_targets(result: Result, folder: Path) -> Iterator[Target]:
    # A machine that only trains needs no OpenSpiel.
    from benchmarks.exploitability import leduc_with_history

    graphs = [file for trained in result.trained.values() for file in trained.graphs.values()]
    values = tuple(round(leduc_with_history(OnnxPolicy(folder / file)), 3) for file in graphs)
    yield Target("leduc_holdem, exploitability of each seed", values, at_most=0.08)
    yield Target("leduc_holdem, mean exploitability", mean(values), at_most=0.06)


def pistonball_jobs(place: Machine, folder: Path) -> list[Job]:
    return [Job("pistonball", "pistonball_gpu", 3 * place.scale, place.cores, folder, on_gpu(place))]


def pistonball_targets(result: Result, folder: Path) -> Iterator[Target]:
    league = LeagueConfig.load(CONFIGS / "pistonball_gpu.yaml")
    ((minutes, file),) = result.trained["pistonball"].graphs.items()
    episodes = EPISODES if result.place.scale == 1 else 1
    served, random = returns(OnnxPolicy(folder / file), league, episodes)
    note = f"random {random.mean():.1f}, {result.trained['pistonball'].rate:,} actions/s"
    yield Target(f"pistonball_gpu, served after {minutes} minutes", served.mean(), at_least=90.0, note=note)


def off_policy_rates(place: Machine, _: Path) -> dict[str, float]:
    """Actions per second in one process: with each number of threads, and on the GPU."""
    threads = {f"threads: {count}": (count, 0) for count in (1, 2, MAX_THREADS) if count <= len(place.cores)}
    gpu = {"GPU": (1, 1)} if place.gpu else {}
    rates = {}
    with local_ray(cpus=2):
        for config in ("simple_spread_qmix", "simple_adversary"):
            league = LeagueConfig.load(CONFIGS / f"{config}.yaml").with_training(runners=0, learning_starts=1000)
            for name, (count, gpus) in (threads | gpu).items():
                torch.set_num_threads(count)
                algorithm = build_algorithm(league.with_training(gpus=gpus), interface(league))
                rates[f"{config}, {name}"], _ = phases.learning(algorithm, phases.PARTS[config], 10 * place.scale)
                algorithm.stop()
    return rates


def off_policy_targets(result: Result, _: Path) -> Iterator[Target]:
    for config in ("simple_spread_qmix", "simple_adversary"):
        rates = {name.removeprefix(f"{config}, "): rate for name, rate in result.rates.items() if config in name}
        gpu = rates.pop("GPU", None)
        best = max(rates, key=lambda name: rates[name])
        if gpu is None:
            yield Target(f"{config}, {best}", round(rates[best]), "steps/s")
        else:
            yield Target(f"{config}, time with the GPU", rates[best] / gpu, "×", at_most=1.0, peer=best)


def on_gpu(place: Machine) -> dict[str, Any]:
    """Settings of a learner on the GPU, if there is one."""
    return {"gpus": 1} if place.gpu else {}


PARTS: dict[str, tuple[Work, Targets]] = {
    "cores": (cores_jobs, cores_targets),
    "gpu": (gpu_jobs, gpu_targets),
    "strength": (strength_jobs, strength_targets),
    "batches": (batches_jobs, batches_targets),
    "leduc": (leduc_jobs, leduc_targets),
    "pistonball": (pistonball_jobs, pistonball_targets),
    "off_policy": (off_policy_rates, off_policy_targets),
}
NEED_GPU = ("gpu", "strength", "pistonball", "off_policy")


def measure(part: str, place: Machine, commit: str, folder: Path) -> Result:
    """Train what a part needs: jobs with different cores at once, others in turn."""
    work = PARTS[part][0](place, folder)
    trained: dict[str, Trained] = {}
    if isinstance(work, list):
        is_disjoint = sum(len(job.cores) for job in work) <= len(place.cores)
        results = in_processes(run, work, len(work) if is_disjoint else 1)
        trained = {job.name: result for job, result in zip(work, results, strict=True)}
    lscpu = subprocess.run("lscpu", capture_output=True, text=True, check=True).stdout
    return Result(part, commit, machine(), place, lscpu, trained, {} if isinstance(work, list) else work)


def main(
    parts: Parts = None,
    quick: Quick = False,
    folder: Annotated[Path | None, typer.Option(help="of results and graphs; default: a temporary one")] = None,
    train_only: Annotated[bool, typer.Option("--train-only", help="play no games")] = False,
    commit: Annotated[str, typer.Option(help="of this code, where it is no git repository")] = "unknown commit",
) -> Iterator[Target]:
    """Measure the parts."""
    gpu = torch.cuda.get_device_name() if torch.cuda.is_available() else ""
    place = Machine(sorted(os.sched_getaffinity(0)), gpu, 1 / 30 if quick else 1.0)
    with tempfile.TemporaryDirectory() as scratch:
        folder = folder or Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        lines = folder / RESULTS
        for part in chosen(parts, PARTS):
            results = map(Result.read, lines.read_text().splitlines()) if lines.exists() else iter(())
            result = next((result for result in results if result.part == part), None)
            if result is None:
                result = measure(part, place, git_commit(ROOT / "pyproject.toml") or commit, folder)
                with lines.open("a") as file:
                    print(json.dumps(asdict(result)), file=file)
            if not train_only:
                yield from judged(result, folder)


def judged(result: Result, folder: Path) -> Iterator[Target]:
    """What follows from a result, with limits if the machine is the one that they are for."""
    place = result.place
    is_limited = place.scale == 1 and len(place.cores) >= CORES and (bool(place.gpu) or result.part not in NEED_GPU)
    for target in PARTS[result.part][1](result, folder):
        limits = {} if is_limited else {"at_least": None, "at_most": None}
        yield replace(target, machine=f"{result.machine}, {place}, {result.commit[:7]}", **limits)
