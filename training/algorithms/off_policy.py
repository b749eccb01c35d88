"""What algorithms share that learn from a replay buffer: sample, keep, learn, follow, hand out weights.

To build one on this (`training/algorithms/dqn.py` is the shortest example):

- settings: a subclass of OffPolicyConfig in league/training_config.py, a member of the union, a name in ALGORITHMS, and
  rows in docs/configuration.md;
- `training/algorithms/<name>.py` with `algorithm_config(league, interface, storage)`, which calls `off_policy_config`
  with a runner, a learner and modules, and `module_spec(settings, interface)`, whose modules are
  `training.modules.acting.Acting`: what is played and exported, and sees its own agent's observation alone;
- the runner: ReplayRunner for each policy's own transitions, JointRunner for joint ones
  (training/sampling/closed.py lists the columns). The buffers' keys are policy ids, or JOINT alone;
- the learner: a subclass of `training.learners.off_policy.OffPolicyLearner`, which holds targets, mixers and critics,
  saves them, and is given samples by the buffers' keys.

Resuming is exact: buffers, targets, optimisers and counters are in the checkpoint, and `begin_anew` derives all that is
random from the seed and the steps behind it.
"""

import time
from collections.abc import Collection
from functools import partial
from pathlib import Path
from typing import Any

from ray.rllib.algorithms.algorithm import Algorithm
from ray.rllib.algorithms.algorithm_config import AlgorithmConfig
from ray.rllib.core import COMPONENT_RL_MODULE
from ray.rllib.core.rl_module.multi_rl_module import MultiRLModuleSpec
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from ray.rllib.utils.metrics import (
    ENV_RUNNER_RESULTS,
    ENV_RUNNER_SAMPLING_TIMER,
    LEARNER_RESULTS,
    LEARNER_UPDATE_TIMER,
    SYNCH_WORKER_WEIGHTS_TIMER,
    TIMERS,
    WEIGHTS_SEQ_NO,
)

from league.config import LeagueConfig
from league.interface import Interface
from league.seeds import derive
from league.settings import Storage
from league.training_config import OffPolicyConfig, TrainingSettings
from training.algorithms import phases
from training.algorithms.setup import begin_anew, configure
from training.curves import EXPLORATION
from training.learners.off_policy import OffPolicyLearner
from training.modules.acting import Acting
from training.replay import Block, Replay
from training.sampling.closed import JOINT
from training.sampling.env_runner import LEAGUE
from training.sampling.replay_runner import JointRunner, ReplayRunner

ITERATION = 1024
"""Actions of one `training_step`, at least: RLlib's bookkeeping around it takes as long as many of them."""
REPLAY = "replay"
"""In a checkpoint: the buffers."""
COUNTERS = "off_policy"


class OffPolicy(Algorithm):
    """RLlib's Algorithm around a replay buffer for each policy, or one of joint transitions."""

    def setup(self, config: AlgorithmConfig) -> None:
        super().setup(config)
        settings = LeagueConfig.model_validate(self.config.env_config[LEAGUE]).training
        assert isinstance(settings, OffPolicyConfig)
        self.settings = settings
        keys = (JOINT,) if issubclass(self.config.env_runner_cls, JointRunner) else tuple(self.config.policies)
        self.replays = {key: Replay(settings.replay_capacity, priorities=settings.priorities) for key in keys}
        self.steps = 0
        """Actions of all agents, those of the versions that training began from included."""
        self._handed_out = 0

    @property
    def exploration(self) -> float:
        """How much is explored now."""
        return self.settings.exploration.at(self.steps)

    def training_step(self) -> None:
        """Rounds of sampling and learning, and what they were like."""
        seconds = dict.fromkeys((ENV_RUNNER_SAMPLING_TIMER, LEARNER_UPDATE_TIMER, SYNCH_WORKER_WEIGHTS_TIMER), 0.0)
        learning = phases.learning(self.settings, tuple(self.config.policies), self.iteration)
        target = self.steps + ITERATION
        while self.steps < target:
            for timer, part in (
                (ENV_RUNNER_SAMPLING_TIMER, self._sample),
                (LEARNER_UPDATE_TIMER, partial(self._learn, learning)),
                (SYNCH_WORKER_WEIGHTS_TIMER, self._hand_out),
            ):
                began = time.perf_counter()
                part()
                seconds[timer] += time.perf_counter() - began
        for timer, value in seconds.items():
            self.metrics.log_value((TIMERS, timer), value, window=1)
        self.metrics.log_value(EXPLORATION, self.exploration, window=1)
        is_local = self.env_runner_group.num_remote_env_runners() == 0
        results = self.env_runner_group.foreach_env_runner(_metrics, local_env_runner=is_local)
        self.metrics.aggregate(results, key=ENV_RUNNER_RESULTS)
        if learned := self._learner.results():
            self.metrics.aggregate([learned], key=LEARNER_RESULTS)

    def begin_anew(self, steps: int) -> None:
        """Leave all episodes under way, and derive every random choice from here on from the seed and `steps`."""
        begin_anew(self, steps)
        self.steps = steps
        for key, replay in self.replays.items():
            replay.reseed(derive(self.config.seed or 0, key), steps)

    def save_to_path(self, path: str | Path, **kwargs: Any) -> str:
        """As RLlib's, with the buffers beside it."""
        written = super().save_to_path(path, **kwargs)
        if self.settings.replay_in_checkpoint:
            for key, replay in self.replays.items():
                replay.save(Path(written) / REPLAY / key)
        return written

    def restore_from_path(self, path: str | Path, *args: Any, **kwargs: Any) -> None:
        """Take over a checkpoint. Raises ConfigError where its buffers are of another capacity; see `replay_is_lost`
        for when they begin empty."""
        super().restore_from_path(path, *args, **kwargs)
        if not replay_is_lost(self.settings, Path(path)):
            for key, replay in self.replays.items():
                replay.load(Path(path) / REPLAY / key)

    def get_state(self, *args: Any, **kwargs: Any) -> dict[str, Any]:
        return super().get_state(*args, **kwargs) | {COUNTERS: {"steps": self.steps}}

    def set_state(self, state: dict[str, Any]) -> None:
        super().set_state(state)
        self.steps = state.get(COUNTERS, {}).get("steps", 0)

    @property
    def _learner(self) -> OffPolicyLearner:
        return self.learner_group._learner

    def _sample(self) -> None:
        """Have all runners play their part of a round."""
        group = self.env_runner_group
        remote = group.num_remote_env_runners()
        play = partial(_play, actions=-(-self.settings.update_every // max(remote, 1)), exploration=self.exploration)
        for actions, blocks in group.foreach_env_runner(play, local_env_runner=not remote):
            self.steps += actions
            for key, block in blocks.items():
                self.replays[key].add(block)

    def _learn(self, learning: Collection[str]) -> None:
        """A round of gradient steps for those whose buffers hold enough."""
        settings = self.settings
        keys = [key for key in self.replays if key == JOINT or key in learning]
        ready = [key for key in keys if len(self.replays[key]) >= settings.learning_starts]
        if not ready:
            return
        for _ in range(settings.updates):
            samples = {
                key: self.replays[key].sample(
                    settings.batch_size, n_step=settings.n_step, gamma=settings.gamma, beta=self._beta
                )
                for key in ready
            }
            for key, errors in self._learner.learn(samples, learning).items():
                self.replays[key].prioritize(samples[key].indices, errors)

    def _hand_out(self) -> None:
        """Give the runners the weights. RLlib's way goes through the object store also for a runner that is here."""
        group, learner = self.env_runner_group, self._learner
        if learner.updates == self._handed_out:
            return
        if group.num_remote_env_runners():
            group.sync_weights(from_worker_or_learner_group=self.learner_group, inference_only=True)
        else:
            weights = {COMPONENT_RL_MODULE: learner.module.get_state(), WEIGHTS_SEQ_NO: learner.updates}
            group.local_env_runner.set_state(weights)
        self._handed_out = learner.updates

    @property
    def _beta(self) -> float:
        priorities = self.settings.priorities
        if priorities is None:
            return 1.0
        return priorities.beta + (1 - priorities.beta) * min(self.steps / self.settings.steps, 1.0)

    def _setup_logdir(self) -> None:
        """RLlib makes a directory for results in the user's home, which are Tune's here."""


class _Config(AlgorithmConfig):
    """RLlib asks for defaults also where all is given."""

    def get_default_rl_module_spec(self) -> RLModuleSpec:
        return RLModuleSpec(module_class=Acting)

    def get_default_learner_class(self) -> type[OffPolicyLearner]:
        return OffPolicyLearner


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
    """RLlib's configuration of an algorithm of this kind. Raises what `configure` raises."""
    config = _Config(algo_class=algorithm)
    configure(config, league, interface, storage, modules=modules, runner=runner, learner=learner)
    config.training(lr=league.training.lr, gamma=league.training.gamma)
    return config


def replay_is_lost(settings: TrainingSettings, checkpoint: Path) -> bool:
    """Whether training that goes on from a checkpoint begins with empty buffers, by configuration or because there are
    none in it."""
    if not isinstance(settings, OffPolicyConfig):
        return False
    return not settings.replay_in_checkpoint or not (checkpoint / REPLAY).is_dir()


def _play(runner: ReplayRunner, actions: int, exploration: float) -> tuple[int, dict[str, Block]]:
    return runner.transitions(actions, exploration)


def _metrics(runner: ReplayRunner) -> dict[str, Any]:
    return runner.get_metrics()
