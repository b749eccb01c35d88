"""Environment runners for off-policy algorithms: exploring play, recorded as transitions for replay."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import torch

from league.config.off_policy import MADDPGConfig
from league.config.opponents import OpponentConfig
from league.random.seeds import derive
from training.modules.distributions import TorchGaussian
from training.replay_buffer import TransitionBlock
from training.sampling.closed_transitions import JointTransitions, JointTransitionsWithoutState, PolicyTransitions
from training.sampling.distributions import OrnsteinUhlenbeck
from training.sampling.env_runner import BatchedEnvRunner, initial_states, one_thread
from training.sampling.episode_chunks import EpisodeChunks


class ReplayRunner(BatchedEnvRunner):
    """Samples each policy's own transitions, for independent learners; turn-based games are supported."""

    recorders: type[PolicyTransitions] | type[JointTransitions] = PolicyTransitions

    def make_env(self) -> None:
        super().make_env()
        assert self.env is not None
        assert self._play is not None
        initial = initial_states(self.module)
        self._closed = self.recorders(self.interface, self.env.agents, self.env.num_envs, initial)
        self._play.recorder = self._closed

    def transitions(
        self, actions: int, exploration: float, opponents: Sequence[OpponentConfig] = ()
    ) -> tuple[int, dict[str, TransitionBlock]]:
        """Play at least `actions` actions of all agents, fewer if no simulator of the game is connected.

        Args:
            actions: Their minimum number.
            exploration: See PolicyModule.
            opponents: Those from the league in new episodes.

        Returns:
            The exact number of actions, and buffer key → completed transitions.
        """
        self.exchange_opponents(opponents)
        assert self._play is not None, "a runner that only holds weights cannot sample"
        play = self._play
        for module in self.module.values():
            module.exploration = exploration
        with self.timed_sample(), self._errors_with_league(), one_thread():
            if not self._has_begun:
                self.reset_episodes(self.num_env_steps_sampled_lifetime)
            before, forward = play.metrics.steps, partial(self._forward, self.module.forward_exploration)
            while play.metrics.steps < before + actions:
                play.step(forward, explore=True)
                if play.is_alone:
                    break
        return play.metrics.steps - before, self._closed.cut()

    def sample_chunks(self, **kwargs: Any) -> list[EpisodeChunks]:
        """Return episode chunks as the base class does, to inspect the policies. Drops the open episodes."""
        assert self._play is not None, "a runner that only holds weights cannot sample"
        if not self._has_begun:
            self.reset_episodes(self.num_env_steps_sampled_lifetime)
        self._play.record_by(self._chunks)
        try:
            return super().sample_chunks(**kwargs)
        finally:
            self._play.record_by(self._closed)

    def reset_episodes(self, steps: int) -> None:
        super().reset_episodes(steps)
        if self.worker_index:
            # A local runner shares the learner's process, where the algorithm seeds torch.
            torch.manual_seed(derive(self.config.seed or 0, "noise", self.worker_index, steps))


class JointRunner(ReplayRunner):
    """Samples joint transitions of all agents with the global state, for centralised learners."""

    recorders = JointTransitions
    gives_states = True


class ActorRunner(JointRunner):
    """Samples joint transitions without the global state.

    Actions of a Box explore by an Ornstein–Uhlenbeck process per agent if `theta` is set, otherwise independently at
    each step; the deviation is part of their distribution inputs.
    """

    recorders = JointTransitionsWithoutState
    gives_states = False

    def make_env(self) -> None:
        super().make_env()
        settings = self.league.training
        assert isinstance(settings, MADDPGConfig)
        assert self.env is not None
        assert self._play is not None
        if settings.theta is not None:
            self._play.noises = {
                policy: OrnsteinUhlenbeck(
                    settings.theta, self.env.num_envs, len(self.env.agents), module.distribution.m
                )
                for policy, module in self.module.items()
                if isinstance(module.distribution, TorchGaussian)
            }
