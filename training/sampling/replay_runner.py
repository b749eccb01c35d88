"""Runners that sample closed transitions for replay instead of episodes."""

from typing import Any

import torch
from ray.rllib.env.single_agent_episode import SingleAgentEpisode

from league.seeds import derive
from training.replay import Block
from training.sampling.closed import JointTransitions, OwnTransitions
from training.sampling.env_runner import LockstepEnvRunner, one_thread


class ReplayRunner(LockstepEnvRunner):
    """Each policy's own transitions: for independent learners, also in turn-based games."""

    recorders: type[OwnTransitions] | type[JointTransitions] = OwnTransitions

    def make_env(self) -> None:
        super().make_env()
        assert self.env is not None
        assert self._play is not None
        self._closed = self.recorders(self.interface, self.env.agents, self.env.copies)
        self._play.recorder = self._closed

    def transitions(self, actions: int, exploration: float) -> tuple[int, dict[str, Block]]:
        """Play at least so many actions of all agents; returns how many they were, and what was closed: policy id →
        transitions. exploration: see Acting."""
        assert self._play is not None, "a runner that only keeps weights cannot sample"
        play = self._play
        for module in self.module.values():
            module.exploration = exploration
        with self._named(), one_thread():
            if not self._has_begun:
                self.begin_anew(self.num_env_steps_sampled_lifetime)
            before = play.metrics.steps
            while play.metrics.steps < before + actions:
                play.step(self._explore, explore=True)
        return play.metrics.steps - before, self._closed.cut()

    def sample(self, **kwargs: Any) -> list[SingleAgentEpisode]:
        """Chunks of episodes, as the base class's: to look at the policies. The episodes under way are left."""
        assert self._play is not None, "a runner that only keeps weights cannot sample"
        if not self._has_begun:
            self.begin_anew(self.num_env_steps_sampled_lifetime)
        self._play.record_by(self._chunks)
        try:
            return super().sample(**kwargs)
        finally:
            self._play.record_by(self._closed)

    def begin_anew(self, steps: int) -> None:
        super().begin_anew(steps)
        if self.worker_index:
            # In the learner's process, the algorithm seeds torch.
            torch.manual_seed(derive(self.config.seed or 0, "noise", self.worker_index, steps))


class JointRunner(ReplayRunner):
    """Joint transitions of all agents, with the global state: for centralised learners."""

    recorders = JointTransitions
    gives_states = True
