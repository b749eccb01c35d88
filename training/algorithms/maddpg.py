"""MADDPG: decentralised actors with centralised critics (Lowe et al., 2017, arXiv 1706.02275).

Each policy has an actor, which takes its agent's observation, and a critic, which takes the observations and actions of
all agents. Only actors act and are exported. Actions of a Box are deterministic plus exploration noise; discrete
actions use Gumbel-softmax. With `critic: own`, a critic takes its own agent only, and the policies are independent DDPG
learners (Lillicrap et al., 2016, arXiv 1509.02971): the baseline for centralised critics.
"""

from collections.abc import Collection

from ray.rllib.algorithms.algorithm_config import AlgorithmConfig

from league.config.league import LeagueConfig
from league.config.off_policy import MADDPGConfig
from league.errors import ConfigError
from league.interface import Interface
from league.settings import Storage
from training.algorithms.metrics import ACTOR_METRICS, OFF_POLICY_METRICS
from training.algorithms.off_policy import OffPolicy
from training.learners.maddpg import MADDPGLearner
from training.modules.maddpg import Actor
from training.sampling.replay_runner import ActorRunner


class MADDPG(OffPolicy):
    """One buffer of joint transitions, from which each policy draws its own samples."""

    settings_class = MADDPGConfig
    module_class = Actor
    learner_class = MADDPGLearner
    runner_class = ActorRunner
    curves = OFF_POLICY_METRICS | ACTOR_METRICS

    @classmethod
    def algorithm_config(cls, league: LeagueConfig, interface: Interface, storage: Storage | None) -> AlgorithmConfig:
        """See `training.algorithms.rllib_config.algorithm_config`."""
        if league.training.opponents.any:
            raise ConfigError(
                "training.opponents: maddpg does not support opponents: its critics need the observations and actions"
                " of all agents; remove it"
            )
        return super().algorithm_config(league, interface, storage)

    def draws_per_step(self, learning: Collection[str]) -> int:
        return len(learning)

    def _learn(self, learning: Collection[str]) -> None:
        learner = self._learner
        assert isinstance(learner, MADDPGLearner)
        learner.set_exploration(self.exploration)
        super()._learn(learning)
