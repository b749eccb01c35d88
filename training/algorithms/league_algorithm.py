"""Base of all algorithms: opponents from the league, and reproducible episodes."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from ray.rllib.algorithms.algorithm import Algorithm
from ray.rllib.algorithms.algorithm_config import AlgorithmConfig

from league.config.league import LeagueConfig
from league.config.schedules import ScheduleProgress
from league.interface import Interface
from league.random.seeds import derive
from training.algorithms.league_opponents import LeagueOpponents
from training.rllib_compat import NoResultsDirectory
from training.sampling.env_runner import INTERFACE, LEAGUE, STORAGE, BatchedEnvRunner
from training.sampling.self_play import OPPONENTS, SCORE

SHARE = "share"
"""Metric of an opponent: its share of the recent episodes."""


class LeagueAlgorithm(NoResultsDirectory, Algorithm):
    """An RLlib Algorithm whose runners play opponents from the league."""

    progress = ScheduleProgress(steps=0, budget=0.0)
    """Where the schedules are in the next iteration. Set before each iteration."""

    def setup(self, config: AlgorithmConfig) -> None:
        super().setup(config)
        env_config = self.config.env_config
        league, interface = (
            LeagueConfig.model_validate(env_config[LEAGUE]),
            Interface.model_validate(env_config[INTERFACE]),
        )
        self.opponents = LeagueOpponents(league, interface, env_config[STORAGE])

    def reset_episodes(self, steps: int) -> None:
        """Drop all open episodes, and derive all further randomness from the seed and `steps`.

        Called at each checkpoint, and when training resumes from one, so that both continue identically.
        """
        self.opponents.reset(steps)
        # With remote runners, the local one only holds weights.
        is_local = self.env_runner_group.num_remote_env_runners() == 0
        opponents = self.opponents.active

        def reset(runner: BatchedEnvRunner) -> None:
            runner.exchange_opponents(opponents)
            runner.reset_episodes(steps)

        self.env_runner_group.foreach_env_runner(reset, local_env_runner=is_local)
        torch.manual_seed(derive(self.config.seed or 0, "learner", steps))

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
        return super().get_state(*args, **kwargs) | {OPPONENTS: self.opponents.get_state()}

    def set_state(self, state: dict[str, Any]) -> None:
        super().set_state(state)
        if OPPONENTS in state:
            self.opponents.set_state(state[OPPONENTS])
