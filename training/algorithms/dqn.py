"""Deep Q-learning with action masks: Mnih et al., 2015, "Human-level control through deep reinforcement learning".

Agents of a policy share one network and one buffer. Each policy learns from its own transitions; in turn-based games,
a transition spans from one of an agent's turns to its next. Illegal actions are never explored, chosen or bootstrapped
from. Recurrent networks learn from sequences of an agent's transitions (Kapturowski et al., 2019, "Recurrent experience
replay in distributed reinforcement learning", without its burn-in, n-step returns and priorities).
"""

from ray.rllib.core.rl_module.multi_rl_module import MultiRLModuleSpec

from league.config.off_policy import DQNConfig
from league.errors import ConfigError
from league.interface import Interface
from league.spaces import Discrete
from training.algorithms.off_policy import OffPolicy
from training.algorithms.rllib_config import encoder_settings, rl_module_specs
from training.learners.dqn import DQNLearner
from training.modules.q_network import QNetwork


class DQN(OffPolicy):
    """Each policy learns from its own buffer."""

    settings_class = DQNConfig
    module_class = QNetwork
    learner_class = DQNLearner

    @classmethod
    def module_spec(cls, settings: DQNConfig, interface: Interface) -> MultiRLModuleSpec:
        """Return the modules of all policies. Raises ConfigError for actions that are not Discrete."""
        for policy in interface.policy_ids:
            action = interface.of_policy(policy).action
            if not isinstance(action, Discrete):
                raise ConfigError(
                    f"policies.{policy}: dqn needs Discrete actions, got {action!r}: train it with algorithm: ppo"
                )
        atoms = settings.distributional
        model_config = encoder_settings(settings) | {
            "dueling": settings.dueling,
            "noisy": settings.noisy,
            "recurrence": settings.recurrence and settings.recurrence.width,
            "atoms": atoms and (atoms.atoms, atoms.low, atoms.high),
        }
        return MultiRLModuleSpec(rl_module_specs=rl_module_specs(interface, cls.module_class, model_config))
