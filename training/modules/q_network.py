"""Values of discrete actions: dueling, distributional and noisy where asked for, and masked wherever it acts."""

from typing import Any

import torch
from ray.rllib.core.columns import Columns
from torch import Tensor, nn

from league.spaces import ACTION_MASK
from training.modules.acting import MASKED, Acting
from training.modules.distributions import Categorical
from training.modules.encoder import Encoder, linear
from training.modules.noisy import NoisyLinear


class QNetwork(Acting):
    """Encoder and heads. model_config: `hidden`, `convolutions`, `normalize` as of the encoder; `dueling`, `noisy`;
    `atoms`, (number, low, high) of the returns that C51's atoms stand for, or None.

    ACTION_DIST_INPUTS are values, MASKED where an action is illegal: their mode is the greedy legal action. While
    exploring they are the logarithms of the probabilities by which ε-greedy play acts.
    """

    def setup(self) -> None:
        config = self.model_config
        self.actions = int(self.action_space.n)
        self.distribution = Categorical(self.actions)
        self.encoder = Encoder(
            self.observation_space, config["hidden"], config.get("convolutions", ()), config.get("normalize", False)
        )
        self.noisy, self.dueling = bool(config.get("noisy")), bool(config.get("dueling"))
        atoms = config.get("atoms")
        self.register_buffer("atoms", torch.linspace(atoms[1], atoms[2], atoms[0]) if atoms else None, persistent=False)
        self.depth = atoms[0] if atoms else 1
        self.advantages = self._head(self.actions * self.depth)
        self.value = self._head(self.depth) if self.dueling else None

    def answers(self, observations: dict[str, Tensor], noise: bool = False) -> Tensor:
        """(B, n) values, or (B, n, atoms) logits of their distributions; not masked.

        Dueling: V + A − mean A (Wang et al., 2016, arXiv 1511.06581, equation 9), the mean of the legal actions: what
        is never played is never learned, and should not move what is.
        """
        noise = noise and self.noisy
        embeddings = self.encoder(observations)
        answers = self._answer(self.advantages, embeddings, noise).unflatten(-1, (self.actions, self.depth))
        if self.value is not None:
            value = self._answer(self.value, embeddings, noise).unsqueeze(-2)
            counted = legal(observations, self.actions).unsqueeze(-1)
            answers = value + answers - (answers * counted).sum(-2, keepdim=True) / counted.sum(-2, keepdim=True)
        return answers if self.atoms is not None else answers.squeeze(-1)

    def expected(self, answers: Tensor) -> Tensor:
        """What `answers` gave → (B, n) values."""
        return answers if self.atoms is None else (answers.softmax(-1) * self.atoms).sum(-1)

    def _forward(self, batch: dict[str, Any], **_: Any) -> dict[str, Any]:
        return {Columns.ACTION_DIST_INPUTS: self._masked(batch[Columns.OBS], noise=False)}

    def _forward_exploration(self, batch: dict[str, Any], **_: Any) -> dict[str, Any]:
        values = self._masked(batch[Columns.OBS], noise=True)
        return {Columns.ACTION_DIST_INPUTS: epsilon_greedy(values, self.exploration)}

    def _masked(self, observations: dict[str, Tensor], noise: bool) -> Tensor:
        values = self.expected(self.answers(observations, noise))
        return masked(values, observations)

    def _head(self, outputs: int) -> nn.Module:
        width = self.encoder.width
        return NoisyLinear(width, outputs) if self.noisy else linear(width, outputs, gain=0.01)

    def _answer(self, head: nn.Module, embeddings: Tensor, noise: bool) -> Tensor:
        return head(embeddings, noise) if isinstance(head, NoisyLinear) else head(embeddings)


def masked(values: Tensor, observations: dict[str, Tensor]) -> Tensor:
    """Values (B, n), MASKED where the mask forbids an action."""
    if ACTION_MASK not in observations:
        return values
    return torch.where(observations[ACTION_MASK].flatten(1).bool(), values, MASKED)


def legal(observations: dict[str, Tensor], actions: int) -> Tensor:
    """(B, n) bool, which actions the mask allows. Where it allows none, as in some environments' last observations, it
    says nothing about what could have been done, and all count."""
    if ACTION_MASK not in observations:
        return next(iter(observations.values())).new_ones(1, actions, dtype=torch.bool)
    allowed = observations[ACTION_MASK].flatten(1).bool()
    return allowed | ~allowed.any(-1, keepdim=True)


def epsilon_greedy(values: Tensor, epsilon: float) -> Tensor:
    """Masked values (B, n) → log-probabilities of acting at random among legal actions with probability ε, else
    greedily; MASKED where they are 0. A value of exactly 0 is one like others."""
    are_legal = values > MASKED
    count = are_legal.sum(-1, keepdim=True).clamp(min=1)
    best = nn.functional.one_hot(values.argmax(-1), values.shape[-1])
    probabilities = are_legal * (epsilon / count) + (1 - epsilon) * best
    return torch.where(probabilities > 0, probabilities.clamp(min=1e-30).log(), MASKED)
