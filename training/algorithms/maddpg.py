"""MADDPG: decentralised actors with centralised critics (Lowe et al., 2017, arXiv 1706.02275).

Each policy has an actor, which takes its agent's observation, and a critic, which takes the observations and actions of
all agents. Only actors act and are exported. Actions of a Box are deterministic plus exploration noise; discrete
actions use Gumbel-softmax. With `critic: own`, a critic takes its own agent only, and the policies are independent DDPG
learners (Lillicrap et al., 2016, arXiv 1509.02971): the baseline for centralised critics.
"""

from collections.abc import Collection

from ray.rllib.algorithms.algorithm_config import AlgorithmConfig
from ray.rllib.core.rl_module.multi_rl_module import MultiRLModuleSpec

from league.config.league import LeagueConfig
from league.config.off_policy import MADDPGConfig
from league.errors import ConfigError
from league.interface import Interface
from league.settings import Storage
from training.algorithms.off_policy import OffPolicy, off_policy_config
from training.algorithms.rllib_config import encoder_settings, rl_module_specs
from training.learners.maddpg import MADDPGLearner
from training.modules.maddpg import Actor
from training.sampling.closed_transitions import JOINT
from training.sampling.replay_runner import ActorRunner


class MADDPG(OffPolicy):
    """One buffer of joint transitions, from which each policy draws its own samples."""

    def _learn(self, learning: Collection[str]) -> None:
        settings, replay, learner = self.settings, self.replays[JOINT], self._learner
        assert isinstance(learner, MADDPGLearner)
        learner.set_exploration(self.exploration)
        if len(replay) < settings.learning_starts:
            return
        for _ in range(settings.updates):
            samples = {
                policy: replay.sample(
                    settings.batch_size, n_step=settings.n_step, gamma=settings.gamma, beta=self._beta
                )
                for policy in learning
            }
            for policy, errors in learner.learn(samples, learning).items():
                replay.prioritize(samples[policy].indices, errors)


def algorithm_config(league: LeagueConfig, interface: Interface, storage: Storage | None = None) -> AlgorithmConfig:
    """See `training.algorithms.rllib_config.algorithm_config`."""
    settings = league.training
    assert isinstance(settings, MADDPGConfig)
    if settings.opponents.any:
        raise ConfigError(
            "training.opponents: maddpg does not support opponents: its critics need the observations and actions"
            " of all agents; remove it"
        )
    return off_policy_config(
        league,
        interface,
        storage,
        modules=module_spec(settings, interface),
        learner=MADDPGLearner,
        runner=ActorRunner,
        algorithm=MADDPG,
    )


def module_spec(settings: MADDPGConfig, interface: Interface) -> MultiRLModuleSpec:
    """Return the actors of all policies. Raises ConfigError for unsupported spaces."""
    return MultiRLModuleSpec(rl_module_specs=rl_module_specs(interface, Actor, encoder_settings(settings)))
