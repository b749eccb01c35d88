"""QMIX, VDN, and independent Q-learning as their baseline.

QMIX: Rashid et al., 2018, arXiv 1803.11485; VDN: Sunehag et al., 2017, arXiv 1706.05296. Each agent of a team acts by
its own action values and observation; a mixer that takes the global state learns from the team's reward. Only the
agents' networks act and are exported; mixers and targets belong to the training state. Differences from the paper:
Adam instead of RMSprop, and feed-forward networks learn from single transitions instead of whole episodes.
"""

from ray.rllib.core.rl_module.multi_rl_module import MultiRLModuleSpec

from league.config.off_policy import QMIXConfig
from league.interface import Interface
from training.algorithms.off_policy import OffPolicy
from training.algorithms.rllib_config import encoder_settings, rl_module_specs
from training.learners.qmix import QMIXLearner, teams
from training.modules.qmix import AgentNetwork
from training.sampling.replay_runner import JointRunner


class QMIX(OffPolicy):
    """All policies learn from one buffer of joint transitions."""

    settings_class = QMIXConfig
    module_class = AgentNetwork
    learner_class = QMIXLearner
    runner_class = JointRunner

    @classmethod
    def module_spec(cls, settings: QMIXConfig, interface: Interface) -> MultiRLModuleSpec:
        """Return the modules of all policies. Raises ConfigError for agents that cannot be mixed."""
        teams(settings.groups, interface)
        model_config = encoder_settings(settings) | {"recurrence": settings.recurrence and settings.recurrence.width}
        return MultiRLModuleSpec(rl_module_specs=rl_module_specs(interface, cls.module_class, model_config))
