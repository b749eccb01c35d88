"""What Ray Tune runs: RLlib's Algorithm, a few updates per step, and its checkpoints."""

import json
import math
import os
import shutil
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from ray import tune
from ray.rllib.algorithms.algorithm import Algorithm
from ray.rllib.utils.metrics import (
    ENV_RUNNER_RESULTS,
    EPISODE_LEN_MEAN,
    EPISODE_MODULE_RETURN_MEAN,
    LEARNER_RESULTS,
    NUM_ENV_STEPS_SAMPLED,
    NUM_EPISODES,
)

from league.config import LeagueConfig
from league.interface import Interface
from training.algorithms.ppo import algorithm_config
from training.sampling.play_metrics import ENTROPY, EPISODE_MODULE_LEN_MEAN

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


class Trial(tune.Trainable):
    """Trains until the budget is spent. config: `league` and `interface` dumped, `start`, `checkpoints` (a path) and
    `runner_cpus`.

    A result names the checkpoint that was made, if any; the driver publishes it.
    """

    def setup(self, config: dict[str, Any]) -> None:
        self.league = LeagueConfig.model_validate(config["league"])
        self.interface = Interface.model_validate(config["interface"])
        self.start: Start = config["start"]
        self.checkpoints: Path = config["checkpoints"]
        # While the learner works, the runners wait: the cores are its own.
        torch.set_num_threads(min(os.cpu_count() or 1, MAX_THREADS))
        self.algorithm = build(self.league, self.interface, self.start.checkpoint, config["runner_cpus"])
        self.steps = self.start.steps
        self.seconds = self.start.seconds
        self._plan_checkpoint()

    def step(self) -> dict[str, Any]:
        """Update until it is time to report; returns this trial's metrics, the newest of each."""
        metrics: dict[str, Any] = {}
        began, steps = time.monotonic(), self.steps
        while time.monotonic() - began < STEP_SECONDS and not self._due():
            updated = time.monotonic()
            result = self.algorithm.train()
            self.seconds += time.monotonic() - updated
            self.steps += int(result[ENV_RUNNER_RESULTS][NUM_ENV_STEPS_SAMPLED])
            metrics |= _metrics(result, self.interface.policy_ids)
        elapsed = time.monotonic() - began
        metrics |= {
            "timesteps_total": self.steps,
            "steps": self.steps - self.start.steps_before_run,
            "seconds": self.seconds,
            "steps_per_second": (self.steps - steps) / elapsed if elapsed else 0.0,
        }
        if self._due():
            metrics["checkpoint"] = str(self._save())
        return metrics | {"done": self._spent()}

    def cleanup(self) -> None:
        self.algorithm.stop()

    def _due(self) -> bool:
        return self.steps >= self.next_steps or self.seconds >= self.next_seconds or self._spent()

    def _spent(self) -> bool:
        settings = self.league.training
        out_of_time = settings.minutes is not None and self.seconds >= 60 * settings.minutes
        return out_of_time or self.steps - self.start.steps_before_run >= settings.steps

    def _plan_checkpoint(self) -> None:
        """At the next multiple of the cadence since the run began, so that an interruption does not shift it."""
        settings, before = self.league.training, self.start.steps_before_run
        self.next_steps = before + _next_multiple(self.steps - before, settings.checkpoint_every)
        minutes = settings.checkpoint_minutes
        self.next_seconds = _next_multiple(self.seconds, None if minutes is None else 60 * minutes)

    def _save(self) -> Path:
        """A directory is a checkpoint as soon as it has its name: it is renamed when it is whole."""
        draft = self.checkpoints / f"{self.steps}.part"
        shutil.rmtree(draft, ignore_errors=True)
        self.algorithm.save_to_path(str(draft))
        progress = {"steps": self.steps, "seconds": self.seconds}
        (draft / PROGRESS_FILE).write_text(json.dumps(progress))
        self._plan_checkpoint()
        return draft.rename(self.checkpoints / str(self.steps))


def _next_multiple(done: float, every: float | None) -> float:
    """The first multiple of `every` beyond `done`; never if there is none."""
    return math.inf if every is None else (done // every + 1) * every


def build(
    league: LeagueConfig, interface: Interface, checkpoint: Path | None = None, runner_cpus: float = 1.0
) -> Algorithm:
    """RLlib's Algorithm of a league, with the state of `checkpoint` if there is one."""
    config = algorithm_config(league, interface)
    algorithm = config.env_runners(num_cpus_per_env_runner=runner_cpus).build_algo()
    if checkpoint is not None:
        algorithm.restore_from_path(str(checkpoint))
    return algorithm


def read_progress(checkpoint: Path) -> tuple[int, float]:
    """Steps and seconds behind a checkpoint."""
    progress = json.loads((checkpoint / PROGRESS_FILE).read_text())
    return int(progress["steps"]), float(progress["seconds"])


def _metrics(result: dict[str, Any], policies: tuple[str, ...]) -> dict[str, Any]:
    """The curves, per policy and of the whole; what did not occur in an update is left out."""
    play, learners = result[ENV_RUNNER_RESULTS], result[LEARNER_RESULTS]
    curves: dict[str, Any] = {"episodes": play.get(NUM_EPISODES), "episode_length": play.get(EPISODE_LEN_MEAN)}
    for policy in policies:
        learner = learners.get(policy, {})
        curves |= {
            f"{policy}/return": play.get(EPISODE_MODULE_RETURN_MEAN, {}).get(policy),
            f"{policy}/length": play.get(EPISODE_MODULE_LEN_MEAN, {}).get(policy),
            f"{policy}/entropy": play.get(policy, {}).get(ENTROPY),
            f"{policy}/policy_loss": learner.get("policy_loss"),
            f"{policy}/value_loss": learner.get("vf_loss"),
            f"{policy}/explained_variance": learner.get("vf_explained_var"),
            f"{policy}/gradient_norm": learner.get("gradient_norm"),
        }
    return {name: float(value) for name, value in curves.items() if value is not None}
