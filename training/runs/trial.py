"""The Ray Tune trial that trains: RLlib's Algorithm, a few updates per step, and its checkpoints.

A checkpoint is saved at the first update that reaches its interval. All episodes and random choices are reset at this
point, so that training resumed from it continues identically. With an interval in steps, a run's versions are therefore
the same, however often it was interrupted (one runner, one machine). With intervals or budgets in minutes, they depend
on the machine's speed.
"""

import json
import math
import time
from collections import Counter
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import ray
import torch
from ray import tune
from ray.rllib.algorithms.algorithm import Algorithm
from ray.rllib.utils.metrics import ENV_RUNNER_RESULTS, NUM_ENV_STEPS_SAMPLED

from league.config.league import LeagueConfig
from league.config.schedules import ScheduleProgress
from league.errors import StorageError
from league.interface import Interface
from league.registry.registry import Registry
from league.settings import Storage
from training.algorithms.league_algorithm import NoSimulator
from training.algorithms.metrics import (
    CHECKPOINT_TIME,
    OTHER_TIME,
    PHASES,
    gpu_use,
    time_each_update,
    totals,
    training_metrics,
)
from training.algorithms.ppo import PPO
from training.algorithms.resources import resources
from training.algorithms.rllib_config import algorithm_config, with_algorithm
from training.rllib_compat import wait_for_runners
from training.runs.checkpoint_digests import write_digests
from training.runs.driver_files import DriverFiles, DriverMachine
from training.sampling.play_metrics import PlayedEpisodes

REPORT_SECONDS = 2.0
"""Interval between a trial's reports, in seconds."""
SIMULATOR_CHECK = 0.25
"""Seconds between two looks whether a simulator has connected."""
NEAR_DUPLICATE = 0.25
"""Part of an interval between checkpoints, below which the end of the time publishes no further version."""
UPDATES, EPISODES = "updates", "finished_episodes"
"""In a result, for callbacks: the metrics of each update since the last result, and the PlayedEpisodes."""
PROGRESS_FILE = "progress.json"
"""In a checkpoint, beside RLlib's state: steps and seconds of training so far."""


@dataclass(frozen=True, slots=True)
class StartState:
    """The state that a trial starts from.

    checkpoint: RLlib's state, or None. steps: actions so far, including parents'. steps_before_run: parents' actions
    only.
    seconds: training time of this run so far.
    """

    checkpoint: Path | None
    steps: int
    steps_before_run: int
    seconds: float


FROM_SCRATCH = StartState(None, 0, 0, 0.0)


@dataclass(frozen=True, slots=True)
class TrialPlan:
    """What a trial needs besides its league.

    start: the initial state. checkpoints: the directory for checkpoints. stop_file: a file whose existence requests
    that the trial saves and ends. cpus: of each learner and runner. threads: of each learner, at most.
    run: the id of the run, which versions are named after. parent: the version that the run started from.
    driver: the machine of these files; None if there is only one.
    """

    start: StartState
    checkpoints: Path
    stop_file: Path
    storage: Storage
    cpus: float = 1.0
    run: str | None = None
    parent: int | None = None
    driver: DriverMachine | None = None


class Trial(tune.Trainable):
    """Trains until the budget is spent or a stop is requested. config: dumped `league` and `interface`, and a `plan`.

    A result contains the path of the checkpoint, if one was saved, whether the budget is `spent`, and Ray's ids of the
    `nodes` of the learners and the runners.
    """

    def setup(self, config: dict[str, Any]) -> None:
        self.plan: TrialPlan = config["plan"]
        self._opened = ExitStack()
        self._fault: Exception | None = None
        try:
            self._begin(config)
        except Exception as error:
            self._fault = error

    def _begin(self, config: dict[str, Any]) -> None:
        self.league = with_algorithm(LeagueConfig.model_validate(config["league"]))
        self.interface = Interface.model_validate(config["interface"])
        self.files = DriverFiles() if self.plan.driver is None else self.plan.driver.files()
        self._opened.callback(self.files.close)
        self.has_callbacks = bool(self.league.training.callbacks) and self.plan.run is not None
        is_external = self.league.environment.external is not None
        self.registry = Registry.open(self.plan.storage, create=False) if is_external else None
        if self.registry is not None:
            self._opened.callback(self.registry.close)
        start = self.plan.start
        checkpoint = None if start.checkpoint is None else self.files.fetch(start.checkpoint)
        self.algorithm = build_algorithm(self.league, self.interface, checkpoint, self.plan.cpus, self.plan.storage)
        self._opened.callback(self.algorithm.stop)
        if start.steps == start.steps_before_run:
            self.algorithm.opponents.refresh(parent=self.plan.parent)
            self.algorithm.curriculum.restart(start.steps)
        else:
            self.algorithm.opponents.drop_removed()
        self.algorithm.reset_episodes(start.steps)
        runner_nodes = self.algorithm.env_runner_group.foreach_env_runner(_node_id, local_env_runner=False)
        further_learners = self.algorithm.further_learners.apply if isinstance(self.algorithm, PPO) else lambda *_: []
        self.nodes = sorted({_node_id(self), *further_learners(_node_id), *runner_nodes})
        threads = resources(self.league, len(self.interface.agents)).threads
        torch.set_num_threads(threads)
        further_learners(lambda _: torch.set_num_threads(threads))
        self.steps = self.saved_steps = start.steps
        self.seconds = self.saved_seconds = start.seconds
        self._plan_checkpoint()

    def step(self) -> dict[str, Any]:
        """Update until a report is due; return the latest value of each metric. Raises what `setup` has raised, too: of
        an exception of a constructor, Ray keeps the text only.
        """
        if self._fault is not None:
            raise self._fault
        metrics: dict[str, Any] = {}
        sums: Counter[str] = Counter()
        updates, episodes = list[dict[str, float]](), list[PlayedEpisodes]()
        began, steps = time.monotonic(), self.steps
        while time.monotonic() - began < REPORT_SECONDS and not self._due():
            if self.registry is not None and not self._has_simulators(self.registry):
                continue
            self.algorithm.progress = ScheduleProgress(self.steps, self._budget_spent())
            updated = time.monotonic()
            try:
                result = self.algorithm.train()
            except NoSimulator:
                continue
            finally:
                self.seconds += time.monotonic() - updated
            self.steps += int(result[ENV_RUNNER_RESULTS][NUM_ENV_STEPS_SAMPLED])
            update = (
                training_metrics(result, self.interface, self.algorithm.curves) | self.algorithm.curriculum.metrics()
            )
            if self.algorithm.curriculum.advance(update, self.steps):
                self.algorithm.reset_episodes(self.steps)
            metrics |= update
            if self.has_callbacks:
                updates.append(update | self._progress())
                episodes += self.algorithm.episodes
            self.algorithm.episodes = []
            sums.update(totals(result))
        elapsed = time.monotonic() - began
        if self.steps > steps:
            other = elapsed - sum(sums[phase] for phase in PHASES)
            metrics |= sums | gpu_use() | {OTHER_TIME: other, "steps_per_second": (self.steps - steps) / elapsed}
        done = self._spent() or self._stop_requested()
        if (done or self._due()) and self.steps > self.saved_steps and not self._is_near_duplicate():
            saving = time.monotonic()
            metrics["checkpoint"] = str(self._save())
            metrics[CHECKPOINT_TIME] = time.monotonic() - saving
        if self.has_callbacks:
            metrics |= {UPDATES: updates, EPISODES: episodes}
        return (
            metrics
            | self._progress()
            | {
                "timesteps_total": self.steps,
                "spent": self._spent(),
                "done": done,
                "nodes": self.nodes,
            }
        )

    def _progress(self) -> dict[str, Any]:
        """Return what the run has done so far: actions, and seconds of training."""
        return {"steps": self.steps - self.plan.start.steps_before_run, "seconds": self.seconds}

    def cleanup(self) -> None:
        self._opened.close()

    def _due(self) -> bool:
        reached = self.steps >= self.next_steps or self.seconds >= self.next_seconds
        return reached or self._spent() or self._stop_requested()

    def _spent(self) -> bool:
        return self._budget_spent() >= 1

    def _budget_spent(self) -> float:
        return self.league.training.budget_spent(self.steps - self.plan.start.steps_before_run, self.seconds)

    def _is_near_duplicate(self) -> bool:
        """Whether time has ended the run so soon after a checkpoint that its version would be almost the same."""
        settings, before = self.league.training, self.plan.start.steps_before_run
        is_planned = self.steps >= self.next_steps or self.seconds >= self.next_seconds
        is_full = settings.max_steps is not None and self.steps - before >= settings.max_steps
        if not self._spent() or is_planned or is_full or self.saved_steps == before:
            return False
        shares = [(self.steps - self.saved_steps) / settings.checkpoint_steps] if settings.checkpoint_steps else []
        if settings.checkpoint_minutes is not None:
            shares.append((self.seconds - self.saved_seconds) / (60 * settings.checkpoint_minutes))
        return max(shares, default=1.0) < NEAR_DUPLICATE

    def _has_simulators(self, registry: Registry) -> bool:
        """Whether simulators are connected. Waiting for them is no part of the run's minutes."""
        with suppress(StorageError):
            gateways = registry.gateways.open(self.league.league)
            if any(gateway.simulators and not gateway.is_evaluation for gateway in gateways):
                return True
        time.sleep(SIMULATOR_CHECK)
        return False

    def _stop_requested(self) -> bool:
        return self.files.exists(self.plan.stop_file)

    def _plan_checkpoint(self) -> None:
        """Schedule the next multiple of the interval since the run began, which an interruption does not shift."""
        settings, before = self.league.training, self.plan.start.steps_before_run
        self.next_steps = before + _next_multiple(self.steps - before, settings.checkpoint_steps)
        minutes = settings.checkpoint_minutes
        self.next_seconds = _next_multiple(self.seconds, None if minutes is None else 60 * minutes)

    def _save(self) -> Path:
        """Save a checkpoint and rename it once complete, so that a named directory is always complete."""
        target = self.plan.checkpoints / str(self.steps)
        draft = self.files.draft(target)
        source = None if self.plan.run is None else f"{self.plan.run}/{self.steps}"
        self.algorithm.opponents.refresh(checkpoint=source, parent=self.plan.parent)
        self.algorithm.save_to_path(str(draft))
        progress = {"steps": self.steps, "seconds": self.seconds}
        (draft / PROGRESS_FILE).write_text(json.dumps(progress))
        write_digests(draft)
        self.files.commit(draft, target)
        self.saved_steps, self.saved_seconds = self.steps, self.seconds
        self._plan_checkpoint()
        self.algorithm.reset_episodes(self.steps)
        return target


def _next_multiple(done: float, every: float | None) -> float:
    """Return the first multiple of `every` beyond `done`; infinity without `every`."""
    return math.inf if every is None else (done // every + 1) * every


def build_algorithm(
    league: LeagueConfig,
    interface: Interface,
    checkpoint: Path | None = None,
    runner_cpus: float = 1.0,
    storage: Storage | None = None,
) -> Algorithm:
    """Build a league's RLlib Algorithm, with the state of `checkpoint` if given.

    storage: where to load opponents' versions from; required only with such opponents.
    """
    config = algorithm_config(league, interface, storage)
    algorithm = config.env_runners(num_cpus_per_env_runner=runner_cpus).build_algo()
    time_each_update(algorithm)
    if checkpoint is not None:
        wait_for_runners(algorithm)
        algorithm.restore_from_path(str(checkpoint))
    return algorithm


def _node_id(_: Any) -> str:
    return str(ray.get_runtime_context().get_node_id())


def read_progress(checkpoint: Path) -> tuple[int, float]:
    """Return the steps and seconds of a checkpoint."""
    progress = json.loads((checkpoint / PROGRESS_FILE).read_text())
    return int(progress["steps"]), float(progress["seconds"])
