"""A residual convolutional network for boards and images (He et al., 2016, arXiv 1512.03385)."""

import gymnasium
import torch
from torch import Tensor, nn

from league.config.network import channels_of


class Residual(nn.Module):
    """The part of the observation with three axes → blocks of convolutions → `width` features; others are appended."""

    def __init__(self, space: gymnasium.spaces.Dict, blocks: int = 4, channels: int = 64, width: int = 256) -> None:
        """space: of the observations, without the action mask."""
        super().__init__()
        shapes = {name: part.shape or (1,) for name, part in space.items()}
        self.image = next(name for name, shape in shapes.items() if len(shape) == 3)
        self.others = [name for name in shapes if name != self.image]
        self.is_first = channels_of(shapes[self.image]) == "first"
        axes = (0, 1, 2) if self.is_first else (2, 0, 1)
        planes, rows, columns = (shapes[self.image][axis] for axis in axes)
        self.first = nn.Conv2d(planes, channels, 3, padding=1)
        self.blocks = nn.ModuleList(Block(channels) for _ in range(blocks))
        # Two planes of all squares, as in the heads of AlphaZero.
        self.last = nn.Conv2d(channels, 2, 1)
        self.features = nn.Linear(2 * rows * columns, width)
        self.width = width + sum(torch.Size(shapes[name]).numel() for name in self.others)

    def forward(self, observations: dict[str, Tensor]) -> Tensor:
        """ONNX input name → (B, …), to (B, width)."""
        image = observations[self.image].float()
        planes = torch.relu(self.first(image if self.is_first else image.permute(0, 3, 1, 2)))
        for block in self.blocks:
            planes = block(planes)
        features = torch.relu(self.features(torch.relu(self.last(planes)).flatten(1)))
        vectors = [observations[name].float().reshape(len(features), -1) for name in self.others]
        return torch.cat([features, *vectors], dim=-1)


class Block(nn.Module):
    """x + f(x) with two convolutions. Without normalisation, f starts at 0 (Zhang et al., 2019, arXiv 1901.09321)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(channels, channels, 3, padding=1)
        self.second = nn.Conv2d(channels, channels, 3, padding=1)
        nn.init.zeros_(self.second.weight)

    def forward(self, planes: Tensor) -> Tensor:
        """(B, channels, rows, columns) → the same."""
        return torch.relu(planes + self.second(torch.relu(self.first(planes))))
