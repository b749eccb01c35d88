"""Self-attention over the entities of an observation (Vaswani et al., 2017, arXiv 1706.03762)."""

import gymnasium
import torch
from torch import Tensor, nn


class Attention(nn.Module):
    """Entities attend to each other and to the rest of the observation, which is a token, too.

    The observation is a vector, in which the entities are `count` times `size` numbers from the index `first`.
    """

    def __init__(
        self, space: gymnasium.spaces.Dict, first: int, count: int, size: int, heads: int = 4, width: int = 64
    ) -> None:
        """space: of the observations, without the action mask."""
        super().__init__()
        ((self.name, vector),) = space.items()
        assert vector.shape is not None
        self.entities = slice(first, first + count * size)
        self.count, self.heads = count, heads
        self.embed = nn.Linear(size, width)
        self.embed_self = nn.Linear(vector.shape[0] - count * size, width)
        self.project = nn.Linear(width, 3 * width)
        self.output = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, width), nn.ReLU())
        self.width = width

    def forward(self, observations: dict[str, Tensor]) -> Tensor:
        """ONNX input name → (B, …), to (B, width)."""
        vector = observations[self.name].float()
        remainder = torch.cat([vector[:, : self.entities.start], vector[:, self.entities.stop :]], dim=-1)
        entities = self.embed(vector[:, self.entities].unflatten(1, (self.count, -1)))
        tokens = torch.cat([self.embed_self(remainder).unsqueeze(1), entities], dim=1)
        # (B, tokens, 3 · width) → three times (B, heads, tokens, width / heads)
        query, key, value = (
            part.unflatten(-1, (self.heads, -1)).transpose(1, 2) for part in self.project(tokens).chunk(3, dim=-1)
        )
        attended = nn.functional.scaled_dot_product_attention(query, key, value)
        return self.output((tokens + attended.transpose(1, 2).flatten(2))[:, 0])
