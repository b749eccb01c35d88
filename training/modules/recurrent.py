"""Recurrent layers: LSTM and GRU, on sequences and single steps."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from training.modules.policy_module import PREVIOUS_ACTION

HIDDEN, CELL = "h", "c"
"""Keys of the state, in the order of the graph's inputs."""

State = dict[str, Tensor]
"""key → (B, width)"""


class LSTMLayer(nn.Module):
    """An LSTM that runs single steps for inference and whole sequences for learning."""

    def __init__(self, inputs: int, width: int) -> None:
        super().__init__()
        self.width = width
        self.lstm = nn.LSTM(inputs, width, batch_first=True)
        for name, parameter in self.lstm.named_parameters():
            nn.init.orthogonal_(parameter) if name.startswith("weight") else nn.init.zeros_(parameter)

    def initial_state(self) -> dict[str, NDArray]:
        """Return key → (width,) float32 zeros."""
        return {key: np.zeros(self.width, np.float32) for key in (HIDDEN, CELL)}

    def step(self, embeddings: Tensor, state: State) -> tuple[Tensor, State]:
        """Run one step: (B, inputs) and the state before → (B, width) and the state after.

        Written out for the exported graph: gates i, f, g, o; c' = σ(f) c + σ(i) tanh(g), h' = σ(o) tanh(c').
        """
        from_input, from_hidden, input_bias, hidden_bias = self.lstm.parameters()
        gates = nn.functional.linear(embeddings, from_input, input_bias)
        gates = gates + nn.functional.linear(state[HIDDEN], from_hidden, hidden_bias)
        enter, keep, new, leave = gates.chunk(4, dim=-1)
        cell = torch.sigmoid(keep) * state[CELL] + torch.sigmoid(enter) * torch.tanh(new)
        hidden = torch.sigmoid(leave) * torch.tanh(cell)
        return hidden, {HIDDEN: hidden, CELL: cell}

    def unroll(self, embeddings: Tensor, lengths: Tensor, state: State) -> Tensor:
        """Run concatenated sequences, (sum of lengths, inputs), each from its own state (S, width) → (…, width)."""
        steps = torch.arange(int(lengths.max()), device=embeddings.device)
        present = steps < lengths.unsqueeze(1)
        padded = embeddings.new_zeros(*present.shape, embeddings.shape[-1])
        padded[present] = embeddings
        outputs, _ = self.lstm(padded, (state[HIDDEN].unsqueeze(0), state[CELL].unsqueeze(0)))
        return outputs[present]


class GRULayer(nn.Module):
    """A GRU that runs single steps, written out for the exported graph."""

    def __init__(self, inputs: int, width: int) -> None:
        super().__init__()
        self.width = width
        self.from_input = nn.Linear(inputs, 3 * width)
        self.from_hidden = nn.Linear(width, 3 * width)
        for layer in (self.from_input, self.from_hidden):
            nn.init.orthogonal_(layer.weight)
            nn.init.zeros_(layer.bias)

    def forward(self, inputs: Tensor, hidden: Tensor) -> Tensor:
        """(B, inputs) and the hidden state (B, width) → the next hidden state.

        Reset gate r, update gate z and candidate n, as in torch.nn.GRU: r = σ(W_r x + U_r h), z = σ(W_z x + U_z h),
        n = tanh(W_n x + r ⊙ U_n h), h' = (1 − z) ⊙ n + z ⊙ h, each W and U with a bias.
        """
        reset_in, update_in, new_in = self.from_input(inputs).chunk(3, dim=-1)
        reset_kept, update_kept, new_kept = self.from_hidden(hidden).chunk(3, dim=-1)
        reset, update = torch.sigmoid(reset_in + reset_kept), torch.sigmoid(update_in + update_kept)
        new = torch.tanh(new_in + reset * new_kept)
        return new + update * (hidden - new)


class ActionGRULayer(GRULayer):
    """A GRU over the steps of an agent, whose input is an embedded observation and the one-hot previous action.

    State: HIDDEN (B, width) and PREVIOUS_ACTION (B, 1).
    """

    def __init__(self, inputs: int, actions: int, width: int) -> None:
        """inputs: width of the embeddings."""
        super().__init__(inputs + actions, width)
        self.actions = actions

    def initial_state(self) -> dict[str, NDArray]:
        """Return the state before an episode's first step, key → (width,) float32 zeros."""
        return {HIDDEN: np.zeros(self.width, np.float32), PREVIOUS_ACTION: np.zeros(1, np.float32)}

    def step(self, embeddings: Tensor, state: State) -> Tensor:
        """Run one step: (B, inputs) and the state before → the hidden state (B, width)."""
        return self(self._with_action(embeddings, state[PREVIOUS_ACTION].squeeze(-1)), state[HIDDEN])

    def unroll(self, embeddings: Tensor, state: State, actions: Tensor, present: Tensor | None = None) -> Tensor:
        """Run T steps of B agents; return the hidden states, (T, B, width).

        Args:
            embeddings: (T, B, inputs).
            state: Before the first step, key → (B, width).
            actions: (T, B), the taken actions.
            present: (T, B) bool; absent agents keep their state. None: all are present.
        """
        hidden, acted = state[HIDDEN], state[PREVIOUS_ACTION].squeeze(-1)
        hidden_states = []
        for step in range(len(embeddings)):
            new = self(self._with_action(embeddings[step], acted), hidden)
            action = actions[step].to(acted.dtype) + 1
            if present is None:
                hidden, acted = new, action
            else:
                hidden = torch.where(present[step].unsqueeze(-1), new, hidden)
                acted = torch.where(present[step], action, acted)
            hidden_states.append(hidden)
        return torch.stack(hidden_states)

    def after(self, embeddings: Tensor, actions: Tensor, hidden: Tensor) -> Tensor:
        """Return the hidden states (B, width) of a step that follows `actions` (B,) and the hidden states (B, width)
        in which they were taken.
        """
        return self(self._with_action(embeddings, actions.to(hidden.dtype) + 1), hidden)

    def _with_action(self, embeddings: Tensor, acted: Tensor) -> Tensor:
        """Append one-hot previous actions to embeddings (B, inputs). acted: (B,), actions plus one, 0 for none."""
        numbers = torch.arange(1, self.actions + 1, device=acted.device, dtype=acted.dtype)
        return torch.cat([embeddings, (acted.unsqueeze(-1) == numbers).to(embeddings.dtype)], dim=-1)


def state_after_best(hidden: Tensor, values: Tensor) -> State:
    """Return the state after the best action by `values` (B, n); a caller that draws another action replaces it."""
    return {HIDDEN: hidden, PREVIOUS_ACTION: values.argmax(-1, keepdim=True).to(hidden.dtype) + 1}
