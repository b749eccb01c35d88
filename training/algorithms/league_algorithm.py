"""Base of all algorithms: opponents from the league, and reproducible episodes."""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import torch
from ray.rllib.algorithms.algorithm import Algorithm
from ray.rllib.algorithms.algorithm_config import AlgorithmConfig
from ray.rllib.core.learner.learner import Learner
from ray.rllib.core.rl_module.multi_rl_module import MultiRLModuleSpec
from ray.rllib.utils.metrics import ENV_RUNNER_RESULTS, ENV_RUNNER_SAMPLING_TIMER

from league.config.league import LeagueConfig
from league.config.schedules import ScheduleProgress
from league.config.training import TrainingSettings
from league.interface import Interface
from league.random.seeds import derive
from league.settings import Storage
from training.algorithms.curriculum import Curriculum
from training.algorithms.league_opponents import LeagueOpponents
from training.modules.policy_module import PolicyModule
from training.rllib_compat import NoResultsDirectory
from training.sampling.env_runner import FINISHED_EPISODES, INTERFACE, LEAGUE, STORAGE, BatchedEnvRunner
from training.sampling.play_metrics import PlayedEpisodes
from training.sampling.self_play import OPPONENTS, SCORE

WAITING_TIMER = "waiting_timer"
"""Of the time in which the learner waits for samples of remote runners."""
CURRICULUM = "curriculum"
"""Key of the curriculum's state in a checkpoint."""
SHARE = "share"
"""Metric of an opponent: its share of the recent episodes."""


class NoSimulator(Exception):
    """`train` cannot continue: no simulator is connected to a runner. What was played belongs to the next update."""


class LeagueAlgorithm(NoResultsDirectory, Algorithm):
    """An RLlib Algorithm whose runners play opponents from the league."""

    settings_class: ClassVar[type[TrainingSettings]]
    """The model of the section `training`, derived from that of the base class."""
    module_class: ClassVar[type[PolicyModule]]
    learner_class: ClassVar[type[Learner]]
    runner_class: ClassVar[type[BatchedEnvRunner]]
    curves: ClassVar[Mapping[str, str]]
    """Curve of each policy → what the learner logs."""
    progress = ScheduleProgress(steps=0, budget=0.0)
    """Where the schedules are in the next iteration. Set before each iteration."""

    @classmethod
    def algorithm_config(cls, league: LeagueConfig, interface: Interface, storage: Storage | None) -> AlgorithmConfig:
        """See `training.algorithms.rllib_config.algorithm_config`."""
        raise NotImplementedError

    @classmethod
    def module_spec(cls, settings: Any, interface: Interface) -> MultiRLModuleSpec:
        """Return the modules of all policies. Raises ConfigError for spaces that the algorithm does not support.

        settings: of `settings_class`.
        """
        raise NotImplementedError

    def setup(self, config: AlgorithmConfig) -> None:
        super().setup(config)
        env_config = self.config.env_config
        self.league = LeagueConfig.model_validate(env_config[LEAGUE])
        interface = Interface.model_validate(env_config[INTERFACE])
        self.episodes: list[PlayedEpisodes] = []
        """Finished since they were last taken, if there are callbacks."""
        self.opponents = LeagueOpponents(self.league, interface, env_config[STORAGE])
        self.curriculum = Curriculum(self.league.training.curriculum)

    @property
    def sampling_timer(self) -> str:
        """The name of the timer of sampling: in this process, or of waiting for remote runners."""
        return WAITING_TIMER if self.env_runner_group.num_remote_env_runners() else ENV_RUNNER_SAMPLING_TIMER

    def reset_episodes(self, steps: int) -> None:
        """Drop all open episodes, and derive all further randomness from the seed and `steps`.

        Called at each checkpoint, and when training resumes from one, so that both continue identically; and when a
        stage of the curriculum begins, in whose environment all runners play from then on.
        """
        self.opponents.reset(steps)
        # With remote runners, the local one only holds weights.
        is_local = self.env_runner_group.num_remote_env_runners() == 0
        opponents, stage = self.opponents.active, self.curriculum.stage

        def reset(runner: BatchedEnvRunner) -> None:
            runner.enter_stage(stage)
            runner.exchange_opponents(opponents)
            runner.reset_episodes(steps)

        self.env_runner_group.foreach_env_runner(reset, local_env_runner=is_local)
        torch.manual_seed(derive(self.config.seed or 0, "learner", steps))

    def add_results(self, results: Sequence[dict[str, Any]]) -> None:
        """Add the runners' metrics of an update; keep their finished episodes in `episodes` for the callbacks."""
        self.episodes += [result.pop(FINISHED_EPISODES) for result in results if FINISHED_EPISODES in result]
        self.metrics.aggregate(results, key=ENV_RUNNER_RESULTS)

    def exchange_opponents(self, results: Sequence[Mapping[str, Any]], actions: int) -> None:
        """Add the episodes of an update, log shares and scores, and draw the opponents of the next one.

        results: the runners' metrics. actions: of all agents in the update.
        """
        self.opponents.add(results, actions)
        for ref, share in self.opponents.shares().items():
            self.metrics.log_value((OPPONENTS, ref, SHARE), share, window=1)
        for ref, score in self.opponents.scores().items():
            self.metrics.log_value((OPPONENTS, ref, SCORE), score, window=1)
        self.opponents.draw()

    def get_state(self, *args: Any, **kwargs: Any) -> dict[str, Any]:
        return super().get_state(*args, **kwargs) | {
            OPPONENTS: self.opponents.get_state(),
            CURRICULUM: self.curriculum.get_state(),
        }

    def set_state(self, state: dict[str, Any]) -> None:
        super().set_state(state)
        if OPPONENTS in state:
            self.opponents.set_state(state[OPPONENTS])
        if CURRICULUM in state:
            self.curriculum.set_state(state[CURRICULUM])
