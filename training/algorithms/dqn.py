"""Deep Q-learning with action masks: Mnih et al., 2015, "Human-level control through deep reinforcement learning".

Agents of a policy share one network and one buffer, and each policy learns from its own transitions, in turn-based
games from one of an agent's own turns to its next. Illegal actions are neither explored, nor chosen, nor bootstrapped
from.
"""

from ray.rllib.algorithms.algorithm_config import AlgorithmConfig
from ray.rllib.core.rl_module.multi_rl_module import MultiRLModuleSpec

from league.config import LeagueConfig
from league.errors import ConfigError
from league.interface import Interface
from league.settings import Storage
from league.spaces import Discrete
from league.training_config import DQNConfig
from training.algorithms.off_policy import off_policy_config
from training.algorithms.setup import specs
from training.learners.dqn import DQNLearner
from training.modules.q_network import QNetwork


def algorithm_config(league: LeagueConfig, interface: Interface, storage: Storage | None = None) -> AlgorithmConfig:
    """RLlib's configuration of a league's training.

    storage: where the versions are that play as opponents; not needed without. Raises ConfigError where settings name
    policies that there are not, or spaces do not fit the module.
    """
    assert isinstance(league.training, DQNConfig)
    modules = module_spec(league.training, interface)
    return off_policy_config(league, interface, storage, modules=modules, learner=DQNLearner)


def module_spec(settings: DQNConfig, interface: Interface) -> MultiRLModuleSpec:
    """The modules of all policies. Raises ConfigError for spaces that they cannot have."""
    for policy in interface.policy_ids:
        action = interface.of_policy(policy).action
        if not isinstance(action, Discrete):
            raise ConfigError(
                f"policies.{policy}: dqn needs Discrete actions, got {action!r}: train it with algorithm: ppo"
            )
    atoms = settings.distributional
    model_config = {
        "hidden": settings.hidden,
        "convolutions": [(layer.filters, layer.kernel, layer.stride) for layer in settings.convolutions],
        "normalize": settings.normalize_observations,
        "dueling": settings.dueling,
        "noisy": settings.noisy,
        "atoms": atoms and (atoms.atoms, atoms.low, atoms.high),
    }
    return MultiRLModuleSpec(rl_module_specs=specs(interface, QNetwork, model_config))
