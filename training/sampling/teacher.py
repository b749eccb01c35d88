"""The teacher of PPO: a script, bot or version whose actions the policy imitates, usually at the start of training.

In the runners, the teacher acts on the observations that the policy itself reaches, and the loss contains the
cross-entropy of its actions: kickstarting (Schmitt et al., 2018, arXiv 1803.03835). With a weight that decreases to 0,
the policy first learns what the teacher knows, and then improves on it by reinforcement learning.
"""

import numpy as np
from numpy.typing import NDArray

from league.config.ppo import TeacherConfig
from league.errors import ConfigError, GameCrashed, one_line
from league.interface import Interface
from league.policies.actions import from_environment
from league.random.seeds import generator
from league.settings import Storage
from league.spaces import Discrete, MultiDiscrete
from training.sampling.episode_chunks import PASS_ROWS, EpisodeChunks, acted_rows
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

    def actions(self, chunks: EpisodeChunks) -> NDArray[np.int64]:
        """Return the teacher's raw actions at the steps of some chunks, (n,) or (n, m). Raises GameCrashed.

        Its random choices depend on the seed and the name of the chunks.
        """
        rng = generator(self._seed, "teacher", chunks.name)
        rows = acted_rows(chunks.lengths)
        parts = []
        for first in range(0, len(rows), PASS_ROWS):
            part = rows[first : first + PASS_ROWS]
            observations = {name: column[part] for name, column in chunks.observations.items()}
            answer = self._policies[chunks.policy].act(observations, rng=[rng] * len(part))
            for fault in answer.faults.values():
                raise GameCrashed(f"training.teacher: {self._ref}: {one_line(fault, with_type=True)}") from fault
            parts.append(answer.actions)
        return from_environment(np.concatenate(parts), self._spaces[chunks.policy])


def check_teacher(interface: Interface) -> None:
    """Raise ConfigError if a policy's actions do not support a teacher."""
    for policy in interface.policy_ids:
        if not isinstance(interface.of_policy(policy).action, Discrete | MultiDiscrete):
            raise ConfigError(f"training.teacher needs discrete actions, but those of {policy} are not")
