"""MADDPG: Lowe et al., 2017, "Multi-agent actor-critic for mixed cooperative-competitive environments",
arXiv 1706.02275. Each policy has an actor, which sees its agent's observation, and a critic, which sees the
observations and actions of all agents; only actors are played and exported. Actions of a Box are deterministic, with
exploration noise while learning; choices are made by Gumbel-softmax.

With `critic: own`, a critic sees its own agent alone, and the policies are independent learners of DDPG (Lillicrap et
al., 2016, arXiv 1509.02971). Nothing else differs: it is what the centralised critics are compared with.
"""

from collections.abc import Collection

from ray.rllib.algorithms.algorithm_config import AlgorithmConfig
from ray.rllib.core.rl_module.multi_rl_module import MultiRLModuleSpec

from league.config import LeagueConfig
from league.errors import ConfigError
from league.interface import Interface
from league.settings import Storage
from league.training_config import MADDPGConfig
from training.algorithms.off_policy import OffPolicy, off_policy_config
from training.algorithms.setup import specs
from training.learners.maddpg import MADDPGLearner
from training.modules.actor import Actor
from training.sampling.actor_runner import ActorRunner
from training.sampling.closed import JOINT


class MADDPG(OffPolicy):
    """Around one buffer of joint transitions, from which each policy draws its own samples."""

    def _learn(self, learning: Collection[str]) -> None:
        settings, replay, learner = self.settings, self.replays[JOINT], self._learner
        assert isinstance(learner, MADDPGLearner)
        learner.explore(self.exploration)
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
    """RLlib's configuration of a league's training. Raises ConfigError for settings that do not fit the league."""
    settings = league.training
    assert isinstance(settings, MADDPGConfig)
    if settings.opponents:
        raise ConfigError(
            "training.opponents: the critics of maddpg learn from what all agents saw and did, which opponents do not"
            " tell: leave it out"
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
    """The actors of all policies. Raises ConfigError for spaces that they cannot have."""
    model_config = {
        "hidden": settings.hidden,
        "convolutions": [(layer.filters, layer.kernel, layer.stride) for layer in settings.convolutions],
        "normalize": settings.normalize_observations,
    }
    return MultiRLModuleSpec(rl_module_specs=specs(interface, Actor, model_config))
