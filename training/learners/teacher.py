"""The teacher of PPO: a script, bot or version whose actions the policy imitates, usually at the start of training.

The teacher acts on the observations that the policy itself reaches, and the loss contains the cross-entropy of its
actions: kickstarting (Schmitt et al., 2018, arXiv 1803.03835). With a weight that decreases to 0, the policy first
learns what the teacher knows, and then improves on it by reinforcement learning.
"""

import numpy as np
import torch
from torch import Tensor

from league.config.ppo import TeacherConfig
from league.errors import ConfigError, GameCrashed, one_line
from league.interface import Interface
from league.settings import Storage
from league.spaces import Discrete, MultiDiscrete
from training.learners.train_batch import PASS_ROWS, TrainBatch
from training.sampling.opponents import policies_of


class Teacher:
    """The policies of a teacher."""

    def __init__(self, settings: TeacherConfig, interface: Interface, storage: Storage | None, seed: int) -> None:
        """Raises ConfigError for an unsuitable teacher, and what loading it raises."""
        self._seed, self._ref = seed, settings.ref
        self._spaces = {policy: interface.of_policy(policy).action for policy in interface.policy_ids}
        self._policies = policies_of(settings.ref, interface, storage, "training.teacher.ref")
        for policy in self._policies.values():
            initial_state = getattr(policy, "initial_state", None)
            if initial_state is not None and initial_state(1):
                raise ConfigError(
                    f"training.teacher.ref: {settings.ref} has a memory, which a teacher does not support"
                )

    def actions(self, policy: str, batch: TrainBatch, update: int) -> Tensor:
        """Return the teacher's raw actions at the steps of a batch, (n,) or (n, m) int64. Raises GameCrashed.

        Args:
            policy: The policy id.
            batch: n steps.
            update: Number of the update, from which the teacher's random choices are derived.
        """
        rng = np.random.default_rng((self._seed, update))
        parts = []
        for rows in batch.acted.split(PASS_ROWS):
            observations = {name: value[rows].cpu().numpy() for name, value in batch.observations.items()}
            answer = self._policies[policy].act(observations, rng=[rng] * len(rows))
            for fault in answer.faults.values():
                raise GameCrashed(f"training.teacher: {self._ref}: {one_line(fault, with_type=True)}") from fault
            parts.append(answer.actions)
        space = self._spaces[policy]
        assert isinstance(space, Discrete | MultiDiscrete)
        # The inverse of `league.policies.actions.to_environment` for discrete actions.
        raw = (np.concatenate(parts) - np.asarray(space.start)).astype(np.int64)
        return torch.from_numpy(raw if isinstance(space, Discrete) else raw.reshape(len(raw), -1)).to(
            batch.acted.device
        )


def check_teacher(interface: Interface) -> None:
    """Raise ConfigError if a policy's actions do not support a teacher."""
    for policy in interface.policy_ids:
        if not isinstance(interface.of_policy(policy).action, Discrete | MultiDiscrete):
            raise ConfigError(f"training.teacher needs discrete actions, but those of {policy} are not")
