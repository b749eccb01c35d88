"""Is this code as fast as another checkout of it: serving, sampling, training, stepping and a tournament?

Both checkouts use the installed dependencies. Each measures itself with its own benchmark modules, in a process of its
own; they alternate within a round, each second round in reverse order, and a ratio is the median over the rounds. Rates
are those of a second of processor time, except for serving, where the server, HAProxy and the load generator share all
cores.
"""

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from statistics import median
from typing import IO, Any

from benchmarks.harness import ROOT, Parts, Quick, Target, chosen

AT_LEAST = 0.97
"""Minimum ratio of each rate to that of the other checkout."""
WORKER = """
import itertools, logging, os, sys, tempfile, time, warnings
from pathlib import Path

warnings.simplefilter("ignore")
os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
# Results go to the real standard output, and what libraries print goes to standard error.
results = os.fdopen(os.dup(1), "w")
os.dup2(2, 1)
logging.disable(logging.WARNING)
home = Path(tempfile.mkdtemp(dir=sys.argv[1]))


def repeat(step, seconds):
    "Results of `step` per second of processor time, summed."
    done, start = 0, time.process_time()
    while (elapsed := time.process_time() - start) < seconds:
        done += step()
    return done / elapsed


%s

rate(0.5)
for line in sys.stdin:
    print(rate(float(line)), file=results, flush=True)
"""
STEPPING = """
from benchmarks import stepping

case = stepping.CASES["{case}"]
number = case.num_envs
# Earlier revisions call it `lockstep`.
batched = getattr(stepping, "batched", None) or stepping.lockstep
environment = batched(case.config, number)


def rate(seconds):
    return repeat(lambda: next(environment) or number, seconds)
"""
SAMPLING = """
import torch
from benchmarks import sampling

torch.set_num_threads(1)
runner = sampling.ours(sampling.{environment}, 32)
# Earlier revisions have only `sample`.
sample = getattr(runner, "sample_chunks", runner.sample)


def rate(seconds):
    return repeat(lambda: sample(num_timesteps=2000) and 2000, seconds)
"""
LEDUC = """
import torch
from benchmarks import sampling
from league.environments.building import interface
from training.algorithms.{algorithm} import algorithm_config

torch.set_num_threads(1)
league = sampling.league(sampling.LEDUC, algorithm="{algorithm}", num_envs=256, hidden=(128, 128))
config = algorithm_config(league, interface(league))
runner = config.env_runner_cls(config, worker_index=0)
sample = getattr(runner, "sample_chunks", runner.sample)
actions = 4096


def play():
    if "{algorithm}" == "dqn":
        return runner.transitions(actions, exploration=0.3)[0]
    sample(num_timesteps=actions)
    return actions


def rate(seconds):
    return repeat(play, seconds)
"""
TRAINING = """
from pathlib import Path

import torch
from benchmarks import sampling
from benchmarks.training.learned import local_ray
from league.config.league import LeagueConfig
from league.environments.building import interface
from training.runs.trial import build_algorithm

if {mlp}:
    league = sampling.league(sampling.FOUR, num_envs="auto", **{settings})
else:
    places = Path("policy_league/configs/connect_four.yaml"), Path("configs/connect_four.yaml")  # now and before 0.1.0
    shipped = next(place for place in places if place.exists())
    league = LeagueConfig.load(shipped).with_training(runners=0, **{settings})
ray = local_ray(cpus=1)
ray.__enter__()
torch.set_num_threads(1)
algorithm = build_algorithm(league, interface(league))
algorithm.reset_episodes(0)
chunks, _ = algorithm.sample_train_batch()


def update():
    return algorithm.learner_group.update(
        episodes=chunks,
        policies=tuple(algorithm.config.policies),
        progress=algorithm.progress,
        num_epochs=algorithm.config.num_epochs,
        minibatch_size=algorithm.config.minibatch_size,
    )


def rate(seconds):
    return repeat(lambda: {step}() and algorithm.config.total_train_batch_size, seconds)
"""
TOURNAMENT = """
from benchmarks import evaluation
from benchmarks.leagues import evaluated_league

config = evaluated_league.CONFIG
if {mlp}:
    training = config.training.model_copy(update={{"convolutions": (), "hidden": (256, 256)}})
    config = config.model_copy(update={{"training": training}})
evaluated_league.CONFIG = config
registry, _ = evaluated_league.publish(home, 2)
schedules = evaluation._schedules(registry, blocks=512)


def rate(seconds):
    return repeat(lambda: evaluation._tournament(next(schedules), registry, 0) and 1024, seconds)
"""
SERVING = """
from benchmarks.load.http import measure
from benchmarks.leagues.served_league import BODY, publish
from benchmarks.serving import _ours

storage = publish(home, versions=1).storage


def rate(seconds):
    with _ours(storage, 1) as url:
        return measure(url, BODY, connections=32, seconds=10 * seconds, warm_up=4).rate
"""
MLP = {"train_batch_size": 4096, "minibatch_size": 512}
CONVOLUTIONAL: dict[str, Any] = {"train_batch_size": 8192, "minibatch_size": 1024, "teacher": None, "opponents": []}
PARTS = {
    "stepping connect_four": STEPPING.format(case="connect_four"),
    "stepping simple_spread": STEPPING.format(case="simple_spread"),
    "sampling connect_four": SAMPLING.format(environment="FOUR"),
    "sampling simple_spread": SAMPLING.format(environment="SPREAD"),
    "sampling leduc by PPO": LEDUC.format(algorithm="ppo"),
    "sampling leduc by DQN": LEDUC.format(algorithm="dqn"),
    "update MLP": TRAINING.format(mlp=True, settings=MLP, step="update"),
    "update convolutional": TRAINING.format(mlp=False, settings=CONVOLUTIONAL, step="update"),
    "iteration MLP": TRAINING.format(mlp=True, settings=MLP, step="algorithm.train"),
    "iteration convolutional": TRAINING.format(mlp=False, settings=CONVOLUTIONAL, step="algorithm.train"),
    "iteration as shipped": TRAINING.format(mlp=False, settings={}, step="algorithm.train"),
    "tournament MLP": TOURNAMENT.format(mlp=True),
    "tournament convolutional": TOURNAMENT.format(mlp=False),
    "serving": SERVING,
}


class Worker:
    """A process that measures a program on request."""

    def __init__(self, command: Sequence[str | Path], directory: Path, environment: Mapping[str, str]) -> None:
        self._process = subprocess.Popen(
            command,
            cwd=directory,
            env=os.environ | environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )

    @classmethod
    def of_checkout(cls, checkout: Path, program: str, scratch: str) -> "Worker":
        """A process that measures one checkout."""
        one_thread = {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(checkout), "PYTHONDONTWRITEBYTECODE": ""}
        return cls([sys.executable, "-c", WORKER % program, scratch], checkout, one_thread)

    def measure(self, seconds: float) -> float:
        """Results per second."""
        print(seconds, file=self._stream(self._process.stdin), flush=True)
        line = self._stream(self._process.stdout).readline()
        if not line:
            raise RuntimeError(f"a measurement ended with exit code {self._process.wait()}")
        return float(line)

    def close(self) -> None:
        """End the process."""
        self._stream(self._process.stdin).close()
        self._process.wait()

    @staticmethod
    def _stream(stream: IO[str] | None) -> IO[str]:
        assert stream is not None
        return stream


def main(
    checkout: Path, parts: Parts = None, quick: Quick = False, rounds: int = 11, seconds: float = 2.0
) -> Iterator[Target]:
    """Measure the parts in both checkouts."""
    rounds, seconds = (3, 0.5) if quick else (rounds, seconds)
    for name, program in chosen(parts, PARTS).items():
        pairs = list(_rounds(checkout, program, rounds, seconds))
        ours, theirs = (median(rates) for rates in zip(*pairs, strict=True))
        ratios = [rate / other for rate, other in pairs]
        note = f"{ours:,.0f} to {theirs:,.0f} per second; {', '.join(f'{ratio:.2f}' for ratio in ratios)}"
        yield Target(name, round(median(ratios), 3), "×", at_least=AT_LEAST, peer=checkout.name, note=note)


def _rounds(checkout: Path, program: str, rounds: int, seconds: float) -> Iterator[tuple[float, float]]:
    """The rates of this and the other checkout, in each round."""
    with _workers(checkout, program) as workers:
        for number in range(rounds):
            order = (0, 1) if number % 2 == 0 else (1, 0)
            rates = {which: workers[which].measure(seconds) for which in order}
            yield rates[0], rates[1]


@contextmanager
def _workers(checkout: Path, program: str) -> Iterator[tuple[Worker, Worker]]:
    with ExitStack() as stack:
        scratch = stack.enter_context(tempfile.TemporaryDirectory())
        checkouts = (ROOT, checkout.resolve())
        first, second = (stack.enter_context(closing(Worker.of_checkout(code, program, scratch))) for code in checkouts)
        yield first, second
