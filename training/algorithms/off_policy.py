"""Base of the algorithms that learn from a replay buffer: sample, store, learn, update targets, sync weights.

To add an algorithm (`policy_league/examples/extending/sac.py` is an example), write:

- the settings: a subclass of OffPolicyConfig;
- the module of a policy: a PolicyModule, which observes one agent only; it acts and is exported;
- the learner: a subclass of `training.learners.off_policy.OffPolicyLearner`. It holds and saves targets, mixers and
  critics, and receives samples by the keys of the buffers;
- the runner: ReplayRunner for transitions of each policy, JointRunner for joint ones (the columns are listed in
  training/sampling/closed_transitions.py). The keys of the buffers are policy ids, or JOINT alone;
- a subclass of OffPolicy that names these, and its entry point in `policy_league.algorithms`.

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
from training.algorithms.league_algorithm import LeagueAlgorithm, NoSimulator
from training.algorithms.metrics import EXPLORATION, OFF_POLICY_METRICS
from training.algorithms.rllib_config import ImportingConfig, configure, encoder_settings, rl_module_specs
from training.learners.off_policy import OffPolicyLearner
from training.replay_buffer import ReplayBuffer, Sample, saved_capacity
from training.rllib_compat import ExplicitConfig, local_learner
from training.sampling.closed_transitions import JOINT
from training.sampling.replay_runner import JointRunner, ReplayRunner

ITERATION_STEPS = 1024
"""Minimum number of actions per `training_step`: RLlib's overhead per call equals the cost of many actions."""
ROWS_AT_ONCE = 8192
"""Number of rows that are drawn at once for several gradient steps; more would take much memory if they hold images."""
REPLAY = "replay"
"""Directory of the buffers in a checkpoint."""
COUNTERS = "off_policy"


class OffPolicyRLlibConfig(ImportingConfig, ExplicitConfig):
    """RLlib's configuration of an off-policy algorithm."""


class OffPolicy(LeagueAlgorithm):
    """An RLlib Algorithm with one replay buffer per policy, or one of joint transitions."""

    settings_class = OffPolicyConfig
    runner_class = ReplayRunner
    curves = OFF_POLICY_METRICS

    @classmethod
    def algorithm_config(cls, league: LeagueConfig, interface: Interface, storage: Storage | None) -> AlgorithmConfig:
        """See `training.algorithms.rllib_config.algorithm_config`."""
        config = OffPolicyRLlibConfig(algo_class=cls)
        configure(config, league, interface, storage)
        assert isinstance(league.training, OffPolicyConfig)
        config.training(lr=league.training.lr, gamma=league.training.gamma)
        return config

    @classmethod
    def module_spec(cls, settings: Any, interface: Interface) -> MultiRLModuleSpec:
        """See `LeagueAlgorithm.module_spec`."""
        return MultiRLModuleSpec(
            rl_module_specs=rl_module_specs(interface, cls.module_class, encoder_settings(settings))
        )

    def setup(self, config: AlgorithmConfig) -> None:
        super().setup(config)
        settings = self.league.training
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
        """Sample and learn in rounds until ITERATION_STEPS actions were taken, and log metrics.

        Ends earlier if no simulator is connected any more. Raises NoSimulator if there was none for a single action.
        """
        seconds = dict.fromkeys((self.sampling_timer, LEARNER_UPDATE_TIMER, SYNCH_WORKER_WEIGHTS_TIMER), 0.0)
        learning = rllib_config.learning_policies(self.settings, tuple(self.config.policies), self.iteration)
        before = self.steps
        target = before + ITERATION_STEPS
        try:
            while self.steps < target:
                for timer, part in (
                    (self.sampling_timer, self._sample),
                    (LEARNER_UPDATE_TIMER, partial(self._learn, learning)),
                    (SYNCH_WORKER_WEIGHTS_TIMER, self._sync_weights),
                ):
                    began = time.perf_counter()
                    part()
                    seconds[timer] += time.perf_counter() - began
        except NoSimulator:
            if self.steps == before:
                raise
        for timer, value in seconds.items():
            self.metrics.log_value((TIMERS, timer), value, window=1)
        self.metrics.log_value(EXPLORATION, self.exploration, window=1)
        is_local = self.env_runner_group.num_remote_env_runners() == 0
        results = self.env_runner_group.foreach_env_runner(ReplayRunner.get_metrics, local_env_runner=is_local)
        self.add_results(results)
        self.exchange_opponents(results, self.steps - before)
        if learned := self._learner.results():
            self.metrics.aggregate([learned], key=LEARNER_RESULTS)

    def reset_episodes(self, steps: int) -> None:
        """Drop all open episodes, and derive all further randomness from the seed and `steps`."""
        super().reset_episodes(steps)
        self.steps = steps
        for key, replay in self.replays.items():
            replay.reseed(derive(self.config.seed or 0, key), steps)

    def draw_sample(self, replay: ReplayBuffer, draws: int = 1) -> Sample:
        """Return concatenated batches: transitions, or sequences of them for recurrent networks."""
        settings = self.settings
        size, gamma = settings.batch_size, settings.gamma
        if isinstance(settings, QLearningConfig) and (recurrence := settings.recurrence) is not None:
            return replay.sample_sequences(draws * size, recurrence.sequence, gamma=gamma)
        priorities = settings.priorities
        beta = 1.0 if priorities is None else priorities.beta + (1 - priorities.beta) * self.progress.budget
        return replay.sample(size, draws=draws, n_step=settings.n_step, gamma=gamma, beta=beta)

    def draws_per_step(self, learning: Collection[str]) -> int:  # noqa: ARG002
        """Return the number of batches that a gradient step takes from each buffer."""
        return 1

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
        """Sample one round from all runners into the buffers. Raises NoSimulator if they took no action."""
        before, group = self.steps, self.env_runner_group
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
        if self.steps == before:
            raise NoSimulator

    def _learn(self, learning: Collection[str]) -> None:
        """Run a round of gradient steps on the buffers that hold enough transitions."""
        settings = self.settings
        keys = [key for key in self.replays if key == JOINT or key in learning]
        ready = [key for key in keys if len(self.replays[key]) >= settings.learning_starts]
        if not ready:
            return
        draws = self.draws_per_step(learning)
        # New priorities affect the next draw.
        most = 1 if settings.priorities else max(1, ROWS_AT_ONCE // (draws * settings.batch_size))
        for first in range(0, settings.updates, most):
            steps = min(most, settings.updates - first)
            samples = {key: self.draw_sample(self.replays[key], steps * draws) for key in ready}
            for key, errors in self._learner.learn(samples, learning, steps).items():
                if settings.priorities:
                    self.replays[key].prioritize(samples[key].indices, errors.cpu().numpy())

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


def starts_with_empty_replay(settings: TrainingSettings, checkpoint: Path) -> bool:
    """Return whether training from a checkpoint starts with empty buffers: as configured, or because it contains none
    of the configured capacity."""
    if not isinstance(settings, OffPolicyConfig):
        return False
    capacities = {saved_capacity(directory) for directory in (checkpoint / REPLAY).glob("*")}
    return not settings.replay_in_checkpoint or capacities != {settings.replay_capacity}
