"""The networks of QMIX and VDN: recurrent agent networks, and mixers of their values.

A mixer is monotonic in each agent's value: actions that are best by the agents' own values are then best for the team,
argmax_u Q_tot = (argmax_u1 Q_1, …, argmax_un Q_n), so that agents can act independently (equations 4 and 5 of the QMIX
paper). Only learning uses mixers.
"""

from typing import Any, Protocol

import torch
from numpy.typing import NDArray
from ray.rllib.core.columns import Columns
from torch import Tensor, nn

from training.modules.distributions import TorchCategorical
from training.modules.encoder import RunningNormalization, linear
from training.modules.policy_module import PolicyModule, mask_illegal
from training.modules.q_network import epsilon_greedy
from training.modules.recurrent import ActionGRULayer, state_after_best

Observations = dict[str, Tensor]


class AgentNetwork(PolicyModule):
    """Encoder, optional GRU and head: values of one agent's actions given its own observations and actions.

    model_config: `hidden`, `convolutions`, `channels`, `normalize` of the encoder; `recurrence`, width of the GRU, or
    None.

    ACTION_DIST_INPUTS are values, MASKED_LOGIT for illegal actions; with exploration, the log-probabilities of ε-greedy
    actions. The GRU's input is the encoded observation and the one-hot previous action, as in the appendix of the QMIX
    paper. Its state: HIDDEN (B, width) and PREVIOUS_ACTION (B, 1).
    """

    def setup(self) -> None:
        config = self.model_config
        self.actions = int(self.action_space.n)
        self.distribution = TorchCategorical(self.actions)
        self.encoder = self.new_encoder()
        width = self.encoder.width
        recurrence = config.get("recurrence")
        self.recurrent = ActionGRULayer(width, self.actions, recurrence) if recurrence else None
        self.head = linear(recurrence or width, self.actions, gain=0.01)

    def get_initial_state(self) -> dict[str, NDArray]:
        """Return the state before an episode's first step, key → (width,); empty if not recurrent."""
        return {} if self.recurrent is None else self.recurrent.initial_state()

    def values(self, observations: Observations) -> Tensor:
        """(B, …) → (B, actions), without masks; not for recurrent networks."""
        assert self.recurrent is None
        return self.head(self.encoder(observations))

    def unroll(
        self, observations: Observations, state: dict[str, Tensor], actions: Tensor, present: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return values and hidden states after each of T steps of B agents, (T, B, …).

        Args:
            observations: (T, B, …).
            state: Before the first step, key → (B, width).
            actions: (T, B), the taken actions.
            present: (T, B) bool; absent agents keep their state.
        """
        assert self.recurrent is not None
        steps, agents = present.shape
        embeddings = self.encoder(flatten_leading(observations)).unflatten(0, (steps, agents))
        hidden = self.recurrent.unroll(embeddings, state, actions, present)
        return self.head(hidden), hidden

    def values_after(self, observations: Observations, actions: Tensor, hidden: Tensor) -> Tensor:
        """Return the values (B, actions) of observations (B, …) that follow `actions` (B,) and the hidden state after
        them.
        """
        assert self.recurrent is not None
        return self.head(self.recurrent.after(self.encoder(observations), actions, hidden))

    def _forward(self, batch: dict[str, Any], **_: Any) -> dict[str, Any]:
        values, hidden = self._step(batch)
        if hidden is None:
            return {Columns.ACTION_DIST_INPUTS: values}
        return {Columns.ACTION_DIST_INPUTS: values, Columns.STATE_OUT: state_after_best(hidden, values)}

    def _forward_exploration(self, batch: dict[str, Any], **_: Any) -> dict[str, Any]:
        values, hidden = self._step(batch)
        log_p = epsilon_greedy(values, self.exploration)
        if hidden is None:
            return {Columns.ACTION_DIST_INPUTS: log_p}
        return {Columns.ACTION_DIST_INPUTS: log_p, Columns.STATE_OUT: state_after_best(hidden, values)}

    def _step(self, batch: dict[str, Any]) -> tuple[Tensor, Tensor | None]:
        """Return masked values, and the next hidden state."""
        observations = batch[Columns.OBS]
        hidden, embeddings = None, self.encoder(observations)
        if self.recurrent is not None:
            embeddings = hidden = self.recurrent.step(embeddings, batch[Columns.STATE_IN])
        return mask_illegal(self.head(embeddings), observations), hidden


def flatten_leading(observations: Observations) -> Observations:
    """Merge the two leading axes."""
    return {name: rows.flatten(0, 1) for name, rows in observations.items()}


class Mixer(Protocol):
    """Values (B, n) of a team's n agents, 0 for absent ones, and states (B, s) → (B, m): one value for the team (m =
    1), or one for each agent.
    """

    def __call__(self, values: Tensor, states: Tensor) -> Tensor: ...


class MonotonicMixer(nn.Module):
    """Rashid et al., 2018, "QMIX: monotonic value function factorisation for deep multi-agent reinforcement learning",
    arXiv 1803.11485, section 4.1:

        Q_tot = |W₂(s)|ᵀ elu(|W₁(s)|ᵀ Q + b₁(s)) + b₂(s),

    where W₁ (n × width), b₁, W₂ (width) are linear in the state s, and b₂ has a hidden layer with ReLU.
    """

    def __init__(self, agents: int, state_size: int, width: int, normalize: bool = False) -> None:
        """normalize: normalise each element of the state by its running mean and deviation."""
        super().__init__()
        self.agents, self.width = agents, width
        self.normalization = RunningNormalization((state_size,)) if normalize else None
        self.first_weights = nn.Linear(state_size, agents * width)
        self.first_bias = nn.Linear(state_size, width)
        self.second_weights = nn.Linear(state_size, width)
        self.second_bias = nn.Sequential(nn.Linear(state_size, width), nn.ReLU(), nn.Linear(width, 1))

    def forward(self, values: Tensor, states: Tensor) -> Tensor:
        """(B, n) and (B, s) → (B, 1)."""
        if self.normalization is not None:
            states = self.normalization(states)
        weights = self.first_weights(states).abs().unflatten(-1, (self.agents, self.width))
        hidden = torch.einsum("bn,bnw->bw", values, weights) + self.first_bias(states)
        mixed = (nn.functional.elu(hidden) * self.second_weights(states).abs()).sum(-1, keepdim=True)
        return mixed + self.second_bias(states)

    def update_statistics(self, states: Tensor, counted: Tensor | None = None) -> None:
        """Update the running statistics of the state, if normalised. counted: see `RunningNormalization.update`."""
        if self.normalization is not None:
            self.normalization.update(states, counted)


def vdn_mixer(values: Tensor, states: Tensor) -> Tensor:  # noqa: ARG001
    """Return Q_tot = Σ Q_i. Sunehag et al., 2017, "Value-decomposition networks for cooperative multi-agent learning",
    arXiv 1706.05296.
    """
    return values.sum(-1, keepdim=True)


def independent_mixer(values: Tensor, states: Tensor) -> Tensor:  # noqa: ARG001
    """Return each agent's own value: independent Q-learning (Tan, 1993)."""
    return values
