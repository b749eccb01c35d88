"""QMIX: Rashid et al., 2018, arXiv 1803.11485; VDN: Sunehag et al., 2017, arXiv 1706.05296; and neither, to compare.

Agents of a team act by values of their own actions, each by what it observes itself, and learn from the team's reward
through a mixer that reads the global state. Only the agents' networks are played, exported and served; mixers and
targets are training state. Deviations from the paper: Adam instead of RMSprop, and feed-forward networks learn from
single transitions instead of whole episodes.
"""

from ray.rllib.algorithms.algorithm_config import AlgorithmConfig
from ray.rllib.core.rl_module.multi_rl_module import MultiRLModuleSpec

from league.config import LeagueConfig
from league.interface import Interface
from league.settings import Storage
from league.training_config import QMIXConfig
from training.algorithms.off_policy import OffPolicy, off_policy_config
from training.algorithms.setup import specs
from training.learners.qmix import QMIXLearner
from training.modules.agent_network import AgentNetwork
from training.replay import Replay, Sample
from training.sampling.replay_runner import JointRunner
from training.teams import teams


class QMIX(OffPolicy):
    """Agents with a memory learn from sequences."""

    def draw(self, replay: Replay) -> Sample:
        """What a gradient step learns from."""
        settings = self.settings
        assert isinstance(settings, QMIXConfig)
        if settings.recurrence is None:
            return super().draw(replay)
        return replay.sample_sequences(settings.batch_size, settings.recurrence.sequence, gamma=settings.gamma)


def algorithm_config(league: LeagueConfig, interface: Interface, storage: Storage | None = None) -> AlgorithmConfig:
    """RLlib's configuration of a league's training.

    storage: where the versions are that play as opponents; not needed without. Raises ConfigError where settings name
    policies or agents that there are not, or spaces do not fit.
    """
    assert isinstance(league.training, QMIXConfig)
    return off_policy_config(
        league,
        interface,
        storage,
        modules=module_spec(league.training, interface),
        learner=QMIXLearner,
        runner=JointRunner,
        algorithm=QMIX,
    )


def module_spec(settings: QMIXConfig, interface: Interface) -> MultiRLModuleSpec:
    """The modules of all policies. Raises ConfigError for agents that cannot be mixed."""
    teams(settings.groups, interface)
    model_config = {
        "hidden": settings.hidden,
        "convolutions": [(layer.filters, layer.kernel, layer.stride) for layer in settings.convolutions],
        "normalize": settings.normalize_observations,
        "recurrence": settings.recurrence and settings.recurrence.width,
    }
    return MultiRLModuleSpec(rl_module_specs=specs(interface, AgentNetwork, model_config))
