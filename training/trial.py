"""What Ray Tune runs: RLlib's Algorithm, a few updates per step, and its checkpoints.

A checkpoint is made at the first update at which its cadence is reached, and begins all episodes and random choices
anew: training that goes on from it goes on as it would have without an interruption. With a cadence in steps, the
versions of a run are therefore the same, however often it was interrupted (one runner, one machine). A cadence or a
budget in minutes depends on the machine's speed, and with it the versions.
"""

import json
import math
import os
import shutil
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from ray import tune
from ray.rllib.algorithms.algorithm import Algorithm
from ray.rllib.utils.metrics import ENV_RUNNER_RESULTS, NUM_ENV_STEPS_SAMPLED

from league.config import LeagueConfig
from league.interface import Interface
from league.settings import Storage
from training.algorithms.dispatch import algorithm_config
from training.curves import CHECKPOINT_TIME, amounts, curves, gpu_use, time_each_update

STEP_SECONDS = 2.0
"""How often a trial reports."""
MAX_THREADS = 4
"""More do not speed up networks of a few hundred units."""
PROGRESS_FILE = "progress.json"
"""In a checkpoint beside RLlib's state: the steps and the seconds of training behind it."""


@dataclass(frozen=True, slots=True)
class Start:
    """Where a trial begins. checkpoint: RLlib's state, None to begin afresh.

    steps: actions behind the checkpoint, those of parents included. steps_before_run: those of parents alone.
    seconds: training time of this run so far.
    """

    checkpoint: Path | None
    steps: int
    steps_before_run: int
    seconds: float


AFRESH = Start(None, 0, 0, 0.0)


@dataclass(frozen=True, slots=True)
class Plan:
    """What a trial needs besides its league.

    start: where it begins. checkpoints: the directory that it writes them to. end: a file whose appearance asks the
    trial to save and end. cpus: of the learner and of each runner. threads: of the learner, at most.
    """

    start: Start
    checkpoints: Path
    end: Path
    storage: Storage
    cpus: float = 1.0
    threads: int = MAX_THREADS


class Trial(tune.Trainable):
    """Trains until the budget is spent, or until it is asked to end. config: `league` and `interface`, dumped, and a
    `plan`.

    A result names the checkpoint that was made, if any, and says whether the budget is `spent`.
    """

    def setup(self, config: dict[str, Any]) -> None:
        self.league = LeagueConfig.model_validate(config["league"])
        self.interface = Interface.model_validate(config["interface"])
        self.plan: Plan = config["plan"]
        # While the learner works, the runners wait: the cores are its own.
        torch.set_num_threads(min(os.cpu_count() or 1, self.plan.threads))
        start = self.plan.start
        self.algorithm = build(self.league, self.interface, start.checkpoint, self.plan.cpus, self.plan.storage)
        self.algorithm.begin_anew(start.steps)
        self.steps = self.saved_steps = start.steps
        self.seconds = start.seconds
        self._plan_checkpoint()

    def step(self) -> dict[str, Any]:
        """Update until it is time to report; returns this trial's metrics, the newest of each."""
        metrics: dict[str, Any] = {}
        sums: Counter[str] = Counter()
        began, steps = time.monotonic(), self.steps
        while time.monotonic() - began < STEP_SECONDS and not self._due():
            updated = time.monotonic()
            result = self.algorithm.train()
            self.seconds += time.monotonic() - updated
            self.steps += int(result[ENV_RUNNER_RESULTS][NUM_ENV_STEPS_SAMPLED])
            metrics |= curves(result, self.interface)
            sums.update(amounts(result))
        elapsed = time.monotonic() - began
        if self.steps > steps:
            metrics |= sums | gpu_use() | {"steps_per_second": (self.steps - steps) / elapsed}
        done = self._spent() or self._is_asked_to_end()
        if (done or self._due()) and self.steps > self.saved_steps:
            saving = time.monotonic()
            metrics["checkpoint"] = str(self._save())
            metrics[CHECKPOINT_TIME] = time.monotonic() - saving
        return metrics | {
            "timesteps_total": self.steps,
            "steps": self.steps - self.plan.start.steps_before_run,
            "seconds": self.seconds,
            "spent": self._spent(),
            "done": done,
        }

    def cleanup(self) -> None:
        self.algorithm.stop()

    def _due(self) -> bool:
        reached = self.steps >= self.next_steps or self.seconds >= self.next_seconds
        return reached or self._spent() or self._is_asked_to_end()

    def _spent(self) -> bool:
        settings = self.league.training
        out_of_time = settings.minutes is not None and self.seconds >= 60 * settings.minutes
        return out_of_time or self.steps - self.plan.start.steps_before_run >= settings.steps

    def _is_asked_to_end(self) -> bool:
        return self.plan.end.exists()

    def _plan_checkpoint(self) -> None:
        """At the next multiple of the cadence since the run began, so that an interruption does not shift it."""
        settings, before = self.league.training, self.plan.start.steps_before_run
        self.next_steps = before + _next_multiple(self.steps - before, settings.checkpoint_every)
        minutes = settings.checkpoint_minutes
        self.next_seconds = _next_multiple(self.seconds, None if minutes is None else 60 * minutes)

    def _save(self) -> Path:
        """A directory is a checkpoint as soon as it has its name: it is renamed when it is whole."""
        draft = self.plan.checkpoints / f"{self.steps}.part"
        shutil.rmtree(draft, ignore_errors=True)
        self.algorithm.save_to_path(str(draft))
        progress = {"steps": self.steps, "seconds": self.seconds}
        (draft / PROGRESS_FILE).write_text(json.dumps(progress))
        whole = draft.rename(self.plan.checkpoints / str(self.steps))
        self.saved_steps = self.steps
        self._plan_checkpoint()
        self.algorithm.begin_anew(self.steps)
        return whole


def _next_multiple(done: float, every: float | None) -> float:
    """The first multiple of `every` beyond `done`; never if there is none."""
    return math.inf if every is None else (done // every + 1) * every


def build(
    league: LeagueConfig,
    interface: Interface,
    checkpoint: Path | None = None,
    runner_cpus: float = 1.0,
    storage: Storage | None = None,
) -> Algorithm:
    """RLlib's Algorithm of a league, with the state of `checkpoint` if there is one.

    storage: where the versions are that play as opponents; not needed without.
    """
    config = algorithm_config(league, interface, storage)
    algorithm = config.env_runners(num_cpus_per_env_runner=runner_cpus).build_algo()
    time_each_update(algorithm)
    if checkpoint is not None:
        # RLlib sends no weights to a runner that has not answered for those before, as one that is still starting: it
        # would go on playing with its initial ones.
        algorithm.env_runner_group.foreach_env_runner("ping", local_env_runner=False)
        algorithm.restore_from_path(str(checkpoint))
    return algorithm


def read_progress(checkpoint: Path) -> tuple[int, float]:
    """Steps and seconds behind a checkpoint."""
    progress = json.loads((checkpoint / PROGRESS_FILE).read_text())
    return int(progress["steps"]), float(progress["seconds"])
