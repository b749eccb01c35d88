"""Values of one agent's actions by what it has observed itself, and done: what QMIX mixes, and what acts."""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from ray.rllib.core.columns import Columns
from torch import Tensor

from training.modules.acting import ACTED, Acting
from training.modules.distributions import Categorical
from training.modules.encoder import Encoder, linear
from training.modules.gated_memory import GatedMemory
from training.modules.memory import HIDDEN
from training.modules.q_network import epsilon_greedy, masked

Observations = dict[str, Tensor]


class AgentNetwork(Acting):
    """Encoder, a memory where asked for, and a head. model_config: `hidden`, `convolutions`, `normalize` as of the
    encoder; `recurrence`, the memory's width or None.

    ACTION_DIST_INPUTS are values, MASKED where an action is illegal; while exploring, the logarithms of the
    probabilities by which ε-greedy play acts. The memory's input is the encoded observation and the last action,
    one-hot, as in the appendix of the QMIX paper. Its state: HIDDEN (B, width) and ACTED (B, 1).
    """

    def setup(self) -> None:
        config = self.model_config
        self.actions = int(self.action_space.n)
        self.distribution = Categorical(self.actions)
        self.encoder = Encoder(
            self.observation_space, config["hidden"], config.get("convolutions", ()), config.get("normalize", False)
        )
        width = self.encoder.width
        recurrence = config.get("recurrence")
        self.memory = GatedMemory(width + self.actions, recurrence) if recurrence else None
        self.head = linear(recurrence or width, self.actions, gain=0.01)

    def get_initial_state(self) -> dict[str, NDArray]:
        """The state before an episode's first step, key → (width,); empty without a memory."""
        if self.memory is None:
            return {}
        return {HIDDEN: np.zeros(self.memory.width, np.float32), ACTED: np.zeros(1, np.float32)}

    def values(self, observations: Observations) -> Tensor:
        """(B, …) → (B, actions), not masked; without a memory."""
        assert self.memory is None
        return self.head(self.encoder(observations))

    def unroll(
        self, observations: Observations, state: dict[str, Tensor], actions: Tensor, present: Tensor
    ) -> tuple[Tensor, Tensor]:
        """T steps of B agents: values and what is remembered behind each step, (T, B, …).

        observations: (T, B, …). state: before the first step, key → (B, width). actions: (T, B) that were taken.
        present: (T, B) bool; who is not there remembers on.
        """
        assert self.memory is not None
        steps, agents = present.shape
        embeddings = self.encoder(flat(observations)).unflatten(0, (steps, agents))
        hidden, acted = state[HIDDEN], state[ACTED].squeeze(-1)
        remembered = []
        for step in range(steps):
            new = self.memory(self._recalling(embeddings[step], acted), hidden)
            hidden = torch.where(present[step].unsqueeze(-1), new, hidden)
            acted = torch.where(present[step], actions[step].to(acted.dtype) + 1, acted)
            remembered.append(hidden)
        behind = torch.stack(remembered)
        return self.head(behind), behind

    def values_after(self, observations: Observations, actions: Tensor, hidden: Tensor) -> Tensor:
        """Values (B, actions) of observations (B, …) that follow actions (B,), with what was remembered then."""
        assert self.memory is not None
        inputs = self._recalling(self.encoder(observations), actions.to(hidden.dtype) + 1)
        return self.head(self.memory(inputs, hidden))

    def _forward(self, batch: dict[str, Any], **_: Any) -> dict[str, Any]:
        values, hidden = self._step(batch)
        if hidden is None:
            return {Columns.ACTION_DIST_INPUTS: values}
        return {Columns.ACTION_DIST_INPUTS: values, Columns.STATE_OUT: _state(hidden, values)}

    def _forward_exploration(self, batch: dict[str, Any], **_: Any) -> dict[str, Any]:
        values, hidden = self._step(batch)
        log_p = epsilon_greedy(values, self.exploration)
        if hidden is None:
            return {Columns.ACTION_DIST_INPUTS: log_p}
        return {Columns.ACTION_DIST_INPUTS: log_p, Columns.STATE_OUT: _state(hidden, values)}

    def _step(self, batch: dict[str, Any]) -> tuple[Tensor, Tensor | None]:
        """Masked values, and what is remembered then."""
        observations = batch[Columns.OBS]
        hidden, embeddings = None, self.encoder(observations)
        if self.memory is not None:
            state = batch[Columns.STATE_IN]
            embeddings = hidden = self.memory(self._recalling(embeddings, state[ACTED].squeeze(-1)), state[HIDDEN])
        return masked(self.head(embeddings), observations), hidden

    def _recalling(self, embeddings: Tensor, acted: Tensor) -> Tensor:
        """(B, width) and the last actions (B,) plus one, 0 at first → the memory's inputs."""
        numbers = torch.arange(1, self.actions + 1, device=acted.device, dtype=acted.dtype)
        return torch.cat([embeddings, (acted.unsqueeze(-1) == numbers).to(embeddings.dtype)], dim=-1)


def _state(hidden: Tensor, values: Tensor) -> dict[str, Tensor]:
    """As if the greedy action were taken; who draws another one puts it in."""
    return {HIDDEN: hidden, ACTED: values.argmax(-1, keepdim=True).to(hidden.dtype) + 1}


def flat(observations: Observations) -> Observations:
    """Two leading axes as one."""
    return {name: rows.flatten(0, 1) for name, rows in observations.items()}
