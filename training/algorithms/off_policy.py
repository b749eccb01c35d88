"""Base of the algorithms that learn from a replay buffer: sample, store, learn, update targets, sync weights.

To add an algorithm (`training/algorithms/dqn.py` is the shortest example), write:

- the settings: a subclass of OffPolicyConfig in league/config/off_policy.py, a member of the union and a name in
  ALGORITHMS (league/config/algorithms.py), and rows in docs/configuration.md;
- `training/algorithms/<name>.py` with `algorithm_config(league, interface, storage)`, which calls `off_policy_config`
  with a runner, a learner and modules, and `module_spec(settings, interface)`. Its modules are PolicyModules, which
  observe one agent only; they act and are exported;
- the runner: ReplayRunner for transitions of each policy, JointRunner for joint ones (the columns are listed in
  training/sampling/closed_transitions.py). The keys of the buffers are policy ids, or JOINT alone;
- the learner: a subclass of `training.learners.off_policy.OffPolicyLearner`. It holds and saves targets, mixers and
  critics, and receives samples by the keys of the buffers.

Resuming is exact: buffers, targets, optimisers and counters are in the checkpoint, and `reset_episodes` derives all
randomness from the seed and the number of steps so far.
"""

import time
from collections.abc import Collection
from functools import partial
from pathlib import Path
from typing import Any

from ray.rllib.algorithms.algorithm_config import AlgorithmConfig
from ray.rllib.core import COMPONENT_RL_MODULE
from ray.rllib.core.rl_module.multi_rl_module import MultiRLModuleSpec
from ray.rllib.utils.metrics import (
    ENV_RUNNER_RESULTS,
    ENV_RUNNER_SAMPLING_TIMER,
    LEARNER_RESULTS,
    LEARNER_UPDATE_TIMER,
    SYNCH_WORKER_WEIGHTS_TIMER,
    TIMERS,
    WEIGHTS_SEQ_NO,
)

from league.config.league import LeagueConfig
from league.config.off_policy import OffPolicyConfig, QLearningConfig
from league.config.training import TrainingSettings
from league.interface import Interface
from league.random.seeds import derive
from league.settings import Storage
from training.algorithms import rllib_config
from training.algorithms.league_algorithm import LeagueAlgorithm
from training.algorithms.metrics import EXPLORATION
from training.algorithms.rllib_config import configure
from training.learners.off_policy import OffPolicyLearner
from training.replay_buffer import ReplayBuffer, Sample, saved_capacity
from training.rllib_compat import ExplicitConfig, local_learner
from training.sampling.closed_transitions import JOINT
from training.sampling.env_runner import LEAGUE
from training.sampling.replay_runner import JointRunner, ReplayRunner

ITERATION_STEPS = 1024
"""Minimum number of actions per `training_step`: RLlib's overhead per call equals the cost of many actions."""
REPLAY = "replay"
"""Directory of the buffers in a checkpoint."""
COUNTERS = "off_policy"


class OffPolicy(LeagueAlgorithm):
    """An RLlib Algorithm with one replay buffer per policy, or one of joint transitions."""

    def setup(self, config: AlgorithmConfig) -> None:
        super().setup(config)
        settings = LeagueConfig.model_validate(self.config.env_config[LEAGUE]).training
        assert isinstance(settings, OffPolicyConfig)
        self.settings = settings
        keys = (JOINT,) if issubclass(self.config.env_runner_cls, JointRunner) else tuple(self.config.policies)
        self.replays = {key: ReplayBuffer(settings.replay_capacity, priorities=settings.priorities) for key in keys}
        self.steps = 0
        """Actions of all agents, including those of parent versions."""
        self._synced_updates = 0

    @property
    def exploration(self) -> float:
        """The current ε, or deviation of the exploration noise."""
        return self.settings.exploration.at(self.steps)

    def training_step(self) -> None:
        """Sample and learn in rounds until ITERATION_STEPS actions were taken, and log metrics."""
        seconds = dict.fromkeys((ENV_RUNNER_SAMPLING_TIMER, LEARNER_UPDATE_TIMER, SYNCH_WORKER_WEIGHTS_TIMER), 0.0)
        learning = rllib_config.learning_policies(self.settings, tuple(self.config.policies), self.iteration)
        before = self.steps
        target = before + ITERATION_STEPS
        while self.steps < target:
            for timer, part in (
                (ENV_RUNNER_SAMPLING_TIMER, self._sample),
                (LEARNER_UPDATE_TIMER, partial(self._learn, learning)),
                (SYNCH_WORKER_WEIGHTS_TIMER, self._sync_weights),
            ):
                began = time.perf_counter()
                part()
                seconds[timer] += time.perf_counter() - began
        for timer, value in seconds.items():
            self.metrics.log_value((TIMERS, timer), value, window=1)
        self.metrics.log_value(EXPLORATION, self.exploration, window=1)
        is_local = self.env_runner_group.num_remote_env_runners() == 0
        results = self.env_runner_group.foreach_env_runner(ReplayRunner.get_metrics, local_env_runner=is_local)
        self.metrics.aggregate(results, key=ENV_RUNNER_RESULTS)
        self.exchange_opponents(results, self.steps - before)
        if learned := self._learner.results():
            self.metrics.aggregate([learned], key=LEARNER_RESULTS)

    def reset_episodes(self, steps: int) -> None:
        """Drop all open episodes, and derive all further randomness from the seed and `steps`."""
        super().reset_episodes(steps)
        self.steps = steps
        for key, replay in self.replays.items():
            replay.reseed(derive(self.config.seed or 0, key), steps)

    def draw_sample(self, replay: ReplayBuffer) -> Sample:
        """Return the sample of one gradient step: transitions, or sequences of them for recurrent networks."""
        settings = self.settings
        if isinstance(settings, QLearningConfig) and (recurrence := settings.recurrence) is not None:
            return replay.sample_sequences(settings.batch_size, recurrence.sequence, gamma=settings.gamma)
        return replay.sample(settings.batch_size, n_step=settings.n_step, gamma=settings.gamma, beta=self._beta)

    def save_to_path(self, path: str | Path, **kwargs: Any) -> str:
        """Save as RLlib does, and the buffers in addition."""
        written = super().save_to_path(path, **kwargs)
        if self.settings.replay_in_checkpoint:
            for key, replay in self.replays.items():
                replay.save(Path(written) / REPLAY / key)
        return written

    def restore_from_path(self, path: str | Path, *args: Any, **kwargs: Any) -> None:
        """Load a checkpoint. See `starts_with_empty_replay` for buffers that are not restored."""
        super().restore_from_path(path, *args, **kwargs)
        if not starts_with_empty_replay(self.settings, Path(path)):
            for key, replay in self.replays.items():
                replay.load(Path(path) / REPLAY / key)

    def get_state(self, *args: Any, **kwargs: Any) -> dict[str, Any]:
        return super().get_state(*args, **kwargs) | {COUNTERS: {"steps": self.steps}}

    def set_state(self, state: dict[str, Any]) -> None:
        super().set_state(state)
        self.steps = state.get(COUNTERS, {}).get("steps", 0)

    @property
    def _learner(self) -> OffPolicyLearner:
        return local_learner(self)

    def _sample(self) -> None:
        """Sample one round from all runners into the buffers."""
        group = self.env_runner_group
        remote = group.num_remote_env_runners()
        play = partial(
            ReplayRunner.transitions,
            actions=-(-self.settings.update_every // max(remote, 1)),
            exploration=self.exploration,
            opponents=self.opponents.active,
        )
        for actions, blocks in group.foreach_env_runner(play, local_env_runner=not remote):
            self.steps += actions
            for key, block in blocks.items():
                self.replays[key].add(block)

    def _learn(self, learning: Collection[str]) -> None:
        """Run a round of gradient steps on the buffers that hold enough transitions."""
        settings = self.settings
        keys = [key for key in self.replays if key == JOINT or key in learning]
        ready = [key for key in keys if len(self.replays[key]) >= settings.learning_starts]
        if not ready:
            return
        for _ in range(settings.updates):
            samples = {key: self.draw_sample(self.replays[key]) for key in ready}
            for key, errors in self._learner.learn(samples, learning).items():
                self.replays[key].prioritize(samples[key].indices, errors)

    def _sync_weights(self) -> None:
        """Send new weights to the runners. For a local runner, this skips RLlib's way through the object store."""
        group, learner = self.env_runner_group, self._learner
        if learner.updates == self._synced_updates:
            return
        if group.num_remote_env_runners():
            group.sync_weights(from_worker_or_learner_group=self.learner_group, inference_only=True)
        else:
            weights = {COMPONENT_RL_MODULE: learner.module.get_state(), WEIGHTS_SEQ_NO: learner.updates}
            group.local_env_runner.set_state(weights)
        self._synced_updates = learner.updates

    @property
    def _beta(self) -> float:
        priorities = self.settings.priorities
        if priorities is None:
            return 1.0
        return priorities.beta + (1 - priorities.beta) * self.progress.budget


def off_policy_config(
    league: LeagueConfig,
    interface: Interface,
    storage: Storage | None,
    *,
    modules: MultiRLModuleSpec,
    learner: type[OffPolicyLearner],
    runner: type[ReplayRunner] = ReplayRunner,
    algorithm: type[OffPolicy] = OffPolicy,
) -> AlgorithmConfig:
    """Return RLlib's configuration of an off-policy algorithm. Raises what `configure` raises."""
    config = ExplicitConfig(algo_class=algorithm)
    configure(config, league, interface, storage, modules=modules, runner=runner, learner=learner)
    config.training(lr=league.training.lr, gamma=league.training.gamma)
    return config


def starts_with_empty_replay(settings: TrainingSettings, checkpoint: Path) -> bool:
    """Return whether training from a checkpoint starts with empty buffers: as configured, or because it contains none
    of the configured capacity."""
    if not isinstance(settings, OffPolicyConfig):
        return False
    capacities = {saved_capacity(directory) for directory in (checkpoint / REPLAY).glob("*")}
    return not settings.replay_in_checkpoint or capacities != {settings.replay_capacity}
