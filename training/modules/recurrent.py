"""Recurrent layers: LSTM and GRU, on sequences and single steps."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

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
