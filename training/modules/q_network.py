"""The Q-network of masked DQN, with a recurrent layer, dueling heads, noisy layers and C51's atoms."""

from typing import Any

import torch
from numpy.typing import NDArray
from ray.rllib.core.columns import Columns
from torch import Tensor, nn

from league.spaces import ACTION_MASK
from training.modules.distributions import TorchCategorical
from training.modules.encoder import linear
from training.modules.policy_module import MASKED_LOGIT, PolicyModule, mask_illegal
from training.modules.recurrent import ActionGRULayer, State, state_after_best

INITIAL_SIGMA = 0.5
"""σ₀ of section 3.2."""


class NoisyLinear(nn.Module):
    """y = (μ_w + σ_w ε_w) x + μ_b + σ_b ε_b with factorised noise, equations 9 to 11: ε_w = f(ε_out) f(ε_in)ᵀ and
    ε_b = f(ε_out), f(x) = sgn(x) √|x|. Without noise, ε = 0."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.inputs, self.outputs = inputs, outputs
        bound = inputs**-0.5
        self.weight = nn.Parameter(torch.empty(outputs, inputs).uniform_(-bound, bound))
        self.bias = nn.Parameter(torch.empty(outputs).uniform_(-bound, bound))
        self.weight_deviation = nn.Parameter(torch.full((outputs, inputs), INITIAL_SIGMA * bound))
        self.bias_deviation = nn.Parameter(torch.full((outputs,), INITIAL_SIGMA * bound))

    def forward(self, x: Tensor, noise: bool = False) -> Tensor:
        """(B, inputs) → (B, outputs). noise: draw new noise, the same for all rows."""
        if not noise:
            return nn.functional.linear(x, self.weight, self.bias)
        draws = (torch.randn(size, device=x.device) for size in (self.inputs, self.outputs))
        incoming, outgoing = (draw.sign() * draw.abs().sqrt() for draw in draws)
        weight = self.weight + self.weight_deviation * torch.outer(outgoing, incoming)
        return nn.functional.linear(x, weight, self.bias + self.bias_deviation * outgoing)


class QNetwork(PolicyModule):
    """Encoder, optional GRU and heads.

    model_config: `hidden`, `convolutions`, `channels`, `normalize` of the encoder; `recurrence`, width of the GRU, or
    None;
    `dueling`, `noisy`; `atoms`, (number, low, high) of C51's returns, or None.

    ACTION_DIST_INPUTS are values, MASKED_LOGIT for illegal actions: their mode is the greedy legal action. With
    exploration they are the log-probabilities of ε-greedy actions.
    """

    def setup(self) -> None:
        config = self.model_config
        self.actions = int(self.action_space.n)
        self.distribution = TorchCategorical(self.actions)
        self.encoder = self.new_encoder()
        self.noisy, self.dueling = bool(config.get("noisy")), bool(config.get("dueling"))
        atoms = config.get("atoms")
        self.register_buffer("atoms", torch.linspace(atoms[1], atoms[2], atoms[0]) if atoms else None, persistent=False)
        self.depth = atoms[0] if atoms else 1
        recurrence = config.get("recurrence")
        self.recurrent = ActionGRULayer(self.encoder.width, self.actions, recurrence) if recurrence else None
        self.width = recurrence or self.encoder.width
        self.advantages = self._head(self.actions * self.depth)
        self.value = self._head(self.depth) if self.dueling else None

    def get_initial_state(self) -> dict[str, NDArray]:
        """Return the state before an episode's first step, key → (width,); empty if not recurrent."""
        return {} if self.recurrent is None else self.recurrent.initial_state()

    def hidden_states(self, observations: dict[str, Tensor], state: State, actions: Tensor, sequence: int) -> Tensor:
        """Return the hidden states (S · T, width) at each step of S concatenated sequences of T = `sequence` steps.

        Args:
            observations: (S · T, …).
            state: Before each step, key → (S · T, width); only those before the first steps are used.
            actions: (S · T,), the taken actions.
            sequence: T.
        """
        assert self.recurrent is not None

        def in_time(column: Tensor) -> Tensor:
            return column.unflatten(0, (-1, sequence)).transpose(0, 1)

        first = {key: in_time(column)[0] for key, column in state.items()}
        hidden = self.recurrent.unroll(in_time(self.encoder(observations)), first, in_time(actions))
        return hidden.transpose(0, 1).flatten(0, 1)

    def hidden_after(self, observations: dict[str, Tensor], actions: Tensor, hidden: Tensor) -> Tensor:
        """Return the hidden states (B, width) at observations (B, …) that follow `actions` (B,) and hidden states."""
        assert self.recurrent is not None
        return self.recurrent.after(self.encoder(observations), actions, hidden)

    def head_outputs(
        self, observations: dict[str, Tensor], noise: bool = False, hidden: Tensor | None = None
    ) -> Tensor:
        """Return values (B, n), or logits (B, n, atoms) of return distributions, without masks.

        hidden: hidden states (B, width) at the observations, if the network is recurrent.

        Dueling: V + A − mean A (Wang et al., 2016, arXiv 1511.06581, equation 9), with the mean over legal actions:
        values of actions that are never played are never learned, and should not affect others.
        """
        noise = noise and self.noisy
        embeddings = self.encoder(observations) if hidden is None else hidden
        answers = self._answer(self.advantages, embeddings, noise).unflatten(-1, (self.actions, self.depth))
        if self.value is not None:
            value = self._answer(self.value, embeddings, noise).unsqueeze(-2)
            counted = legal_actions(observations, self.actions).unsqueeze(-1)
            answers = value + answers - (answers * counted).sum(-2, keepdim=True) / counted.sum(-2, keepdim=True)
        return answers if self.atoms is not None else answers.squeeze(-1)

    def expected(self, answers: Tensor) -> Tensor:
        """Convert `head_outputs` to values, (B, n)."""
        return answers if self.atoms is None else (answers.softmax(-1) * self.atoms).sum(-1)

    def _forward(self, batch: dict[str, Any], **_: Any) -> dict[str, Any]:
        values, state = self._step(batch, noise=False)
        return {Columns.ACTION_DIST_INPUTS: values} | state

    def _forward_exploration(self, batch: dict[str, Any], **_: Any) -> dict[str, Any]:
        values, state = self._step(batch, noise=True)
        return {Columns.ACTION_DIST_INPUTS: epsilon_greedy(values, self.exploration)} | state

    def _step(self, batch: dict[str, Any], noise: bool) -> tuple[Tensor, dict[str, Any]]:
        """Return masked values, and the next state as STATE_OUT if the network is recurrent."""
        observations, hidden = batch[Columns.OBS], None
        if self.recurrent is not None:
            hidden = self.recurrent.step(self.encoder(observations), batch[Columns.STATE_IN])
        values = mask_illegal(self.expected(self.head_outputs(observations, noise, hidden)), observations)
        return values, {} if hidden is None else {Columns.STATE_OUT: state_after_best(hidden, values)}

    def _head(self, outputs: int) -> nn.Module:
        return NoisyLinear(self.width, outputs) if self.noisy else linear(self.width, outputs, gain=0.01)

    def _answer(self, head: nn.Module, embeddings: Tensor, noise: bool) -> Tensor:
        return head(embeddings, noise) if isinstance(head, NoisyLinear) else head(embeddings)


def legal_actions(observations: dict[str, Tensor], actions: int) -> Tensor:
    """Return (B, n) bool, which actions the mask allows.

    If the mask allows no action, as in the last observations of some environments, all actions count.
    """
    if ACTION_MASK not in observations:
        return next(iter(observations.values())).new_ones(1, actions, dtype=torch.bool)
    allowed = observations[ACTION_MASK].flatten(1).bool()
    return allowed | ~allowed.any(-1, keepdim=True)


def epsilon_greedy(values: Tensor, epsilon: float) -> Tensor:
    """Convert masked values (B, n) to log-probabilities of ε-greedy actions among the legal ones.

    Illegal actions have MASKED_LOGIT.
    """
    are_legal = values > MASKED_LOGIT
    count = are_legal.sum(-1, keepdim=True).clamp(min=1)
    best = nn.functional.one_hot(values.argmax(-1), values.shape[-1])
    probabilities = are_legal * (epsilon / count) + (1 - epsilon) * best
    return torch.where(probabilities > 0, probabilities.clamp(min=1e-30).log(), MASKED_LOGIT)
