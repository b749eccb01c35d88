"""A gated recurrent unit over the steps of an episode: Cho et al., 2014, arXiv 1406.1078."""

import torch
from torch import Tensor, nn


class GatedMemory(nn.Module):
    """One step by weights that learning and acting share; written out, since this becomes the graph."""

    def __init__(self, inputs: int, width: int) -> None:
        super().__init__()
        self.width = width
        self.from_input = nn.Linear(inputs, 3 * width)
        self.from_hidden = nn.Linear(width, 3 * width)
        for layer in (self.from_input, self.from_hidden):
            nn.init.orthogonal_(layer.weight)
            nn.init.zeros_(layer.bias)

    def forward(self, inputs: Tensor, hidden: Tensor) -> Tensor:
        """(B, inputs) and what is remembered (B, width) → what is remembered then.

        Gates r, z and candidate n, as torch.nn.GRU has them: r = σ(W_r x + U_r h), z = σ(W_z x + U_z h),
        n = tanh(W_n x + r ⊙ U_n h), h' = (1 − z) ⊙ n + z ⊙ h, each W and U with a bias.
        """
        reset_in, update_in, new_in = self.from_input(inputs).chunk(3, dim=-1)
        reset_kept, update_kept, new_kept = self.from_hidden(hidden).chunk(3, dim=-1)
        reset, update = torch.sigmoid(reset_in + reset_kept), torch.sigmoid(update_in + update_kept)
        new = torch.tanh(new_in + reset * new_kept)
        return new + update * (hidden - new)
