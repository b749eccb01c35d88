"""A long short-term memory over the steps of an episode: Hochreiter and Schmidhuber, 1997, Neural Computation 9(8)."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

HIDDEN, CELL = "h", "c"
"""Keys of the state, in the order in which a graph takes them."""

State = dict[str, Tensor]
"""key → (B, width)"""


class Memory(nn.Module):
    """One step when acting, whole sequences when learning, by the same weights."""

    def __init__(self, inputs: int, width: int) -> None:
        super().__init__()
        self.width = width
        self.lstm = nn.LSTM(inputs, width, batch_first=True)
        for name, parameter in self.lstm.named_parameters():
            nn.init.orthogonal_(parameter) if name.startswith("weight") else nn.init.zeros_(parameter)

    def initial_state(self) -> dict[str, NDArray]:
        """key → (width,) float32: zeros."""
        return {key: np.zeros(self.width, np.float32) for key in (HIDDEN, CELL)}

    def step(self, embeddings: Tensor, state: State) -> tuple[Tensor, State]:
        """(B, inputs) and the state before → (B, width) and the state after.

        Written out, since this becomes the graph: gates i, f, g, o; c' = σ(f) c + σ(i) tanh(g), h' = σ(o) tanh(c').
        """
        from_input, from_hidden, input_bias, hidden_bias = self.lstm.parameters()
        gates = nn.functional.linear(embeddings, from_input, input_bias)
        gates = gates + nn.functional.linear(state[HIDDEN], from_hidden, hidden_bias)
        enter, keep, new, leave = gates.chunk(4, dim=-1)
        cell = torch.sigmoid(keep) * state[CELL] + torch.sigmoid(enter) * torch.tanh(new)
        hidden = torch.sigmoid(leave) * torch.tanh(cell)
        return hidden, {HIDDEN: hidden, CELL: cell}

    def unroll(self, embeddings: Tensor, lengths: Tensor, state: State) -> Tensor:
        """Sequences one behind another, (sum of lengths, inputs), each from its own state (S, width) → (…, width)."""
        steps = torch.arange(int(lengths.max()), device=embeddings.device)
        present = steps < lengths.unsqueeze(1)
        padded = embeddings.new_zeros(*present.shape, embeddings.shape[-1])
        padded[present] = embeddings
        outputs, _ = self.lstm(padded, (state[HIDDEN].unsqueeze(0), state[CELL].unsqueeze(0)))
        return outputs[present]
