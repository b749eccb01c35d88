"""Deep sets (Zaheer et al., 2017, arXiv 1703.06114): the order of entities in an observation does not matter."""

import gymnasium
import torch
from torch import Tensor, nn


class DeepSets(nn.Module):
    """Embeds each entity by the same layers, takes mean and maximum, and joins them with the rest of the observation.

    The observation is a vector, in which the entities are `count` times `size` numbers from the index `first`.
    """

    def __init__(
        self, space: gymnasium.spaces.Dict, first: int, count: int, size: int, hidden: int = 64, width: int = 128
    ) -> None:
        """space: of the observations, without the action mask."""
        super().__init__()
        ((self.name, vector),) = space.items()
        assert vector.shape is not None
        self.entities = slice(first, first + count * size)
        self.count = count
        self.embed = nn.Sequential(nn.Linear(size, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU())
        remainder = vector.shape[0] - count * size
        self.join = nn.Sequential(
            nn.Linear(2 * hidden + remainder, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU()
        )
        self.width = width

    def forward(self, observations: dict[str, Tensor]) -> Tensor:
        """ONNX input name → (B, …), to (B, width)."""
        vector = observations[self.name].float()
        entities = self.embed(vector[:, self.entities].unflatten(1, (self.count, -1)))
        remainder = [vector[:, : self.entities.start], vector[:, self.entities.stop :]]
        return self.join(torch.cat([entities.mean(1), entities.amax(1), *remainder], dim=-1))
