"""The runner of deterministic policies: joint transitions, and noise that goes on from one step to the next."""

from league.training_config import MADDPGConfig
from training.modules.distributions import Gaussian
from training.sampling.closed import JointWithoutStates
from training.sampling.noise import OrnsteinUhlenbeck
from training.sampling.replay_runner import JointRunner


class ActorRunner(JointRunner):
    """Joint transitions without the global state. Actions of a Box explore by a process of their agent's own where
    `theta` is set, else independently at each step; the deviation is part of the inputs of their distributions."""

    recorders = JointWithoutStates
    gives_states = False

    def make_env(self) -> None:
        super().make_env()
        settings = self.league.training
        assert isinstance(settings, MADDPGConfig)
        assert self.env is not None
        assert self._play is not None
        if settings.theta is not None:
            self._play.noises = {
                policy: OrnsteinUhlenbeck(settings.theta, self.env.copies, len(self.env.agents), module.distribution.m)
                for policy, module in self.module.items()
                if isinstance(module.distribution, Gaussian)
            }
