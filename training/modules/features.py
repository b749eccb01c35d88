"""Observations in the environment's dtype → one row of float32 each.

Each part of an observation is brought to numbers that a network can take: integers become one-hot, boxes with wide
finite bounds, such as the 0 to 255 of pictures, are scaled to [0, 1] by them, and all else is taken as it is.
"""

from collections.abc import Sequence

import gymnasium
import numpy as np
import torch
from torch import Tensor, nn

from league.errors import ConfigError
from league.spaces import ACTION_MASK
from training.modules.normalization import RunningNormalization

WIDE, ABSURD = 100.0, 1e6
"""Spans between bounds from which on a Box is scaled, and beyond which its bounds say nothing about its values."""

Convolutions = Sequence[tuple[int, int, int]]
"""(filters, kernel, stride) each, without padding."""


class Features(nn.Module):
    """Concatenates all parts of an observation but the action mask.

    A Box of planes, (height, width, channels), passes through the convolutions, ReLU behind each; others are flattened.
    normalize: shift and scale parts that are boxes of floats by running statistics instead of their bounds.
    Input: ONNX input name → (B, …). Output: (B, width) float32. Raises ConfigError if the convolutions do not fit.
    """

    def __init__(self, space: gymnasium.spaces.Dict, convolutions: Convolutions = (), normalize: bool = False) -> None:
        super().__init__()
        spaces = {name: part for name, part in sorted(space.spaces.items()) if name != ACTION_MASK}
        self.names = tuple(spaces)
        # A list, since names may hold dots, which torch's ModuleDict refuses.
        self.parts = nn.ModuleList(_part(part, convolutions, normalize) for part in spaces.values())
        if convolutions and not any(isinstance(part, Planes) for part in self.parts):
            raise ConfigError("training.convolutions: no part of the observation is a Box of (height, width, channels)")
        with torch.no_grad():
            example = {name: torch.as_tensor(part.sample())[None] for name, part in spaces.items()}
            self.width = self(example).shape[-1]

    def forward(self, observations: dict[str, Tensor]) -> Tensor:
        rows = [part(observations[name]) for name, part in zip(self.names, self.parts, strict=True)]
        return rows[0] if len(rows) == 1 else torch.cat(rows, dim=-1)

    def update_statistics(self, observations: dict[str, Tensor]) -> None:
        """Take a batch into the running statistics of the parts that have some."""
        for name, part in zip(self.names, self.parts, strict=True):
            for layer in part.modules():
                if isinstance(layer, RunningNormalization):
                    layer.update(observations[name])


class OneHot(nn.Module):
    """Integers (B, …), element i in [starts[i], starts[i] + sizes[i]), → (B, sum of sizes)."""

    columns: Tensor
    values: Tensor

    def __init__(self, starts: Sequence[int], sizes: Sequence[int]) -> None:
        super().__init__()
        columns = np.repeat(np.arange(len(sizes)), sizes)
        values = np.concatenate([start + np.arange(size) for start, size in zip(starts, sizes, strict=True)])
        self.register_buffer("columns", torch.as_tensor(columns), persistent=False)
        self.register_buffer("values", torch.as_tensor(values), persistent=False)

    def forward(self, integers: Tensor) -> Tensor:
        flat = integers.reshape(integers.shape[0], -1).long()
        return (flat[:, self.columns] == self.values).float()


class Scaled(nn.Module):
    """Bounds [low, high] → [0, 1]."""

    low: Tensor
    share: Tensor

    def __init__(self, low: np.ndarray, high: np.ndarray) -> None:
        super().__init__()
        self.starts_at_zero = not low.any()
        self.register_buffer("low", torch.as_tensor(low, dtype=torch.float32), persistent=False)
        self.register_buffer("share", torch.as_tensor(1 / (high - low), dtype=torch.float32), persistent=False)

    def forward(self, values: Tensor) -> Tensor:
        values = values.float()
        return values * self.share if self.starts_at_zero else (values - self.low) * self.share


class Cast(nn.Module):
    """Any numbers as float32."""

    def forward(self, values: Tensor) -> Tensor:
        return values.float()


class Planes(nn.Module):
    """Numbers (B, height, width, channels) → convolutions → (B, width)."""

    def __init__(self, numbers: nn.Module, shape: tuple[int, ...], convolutions: Convolutions) -> None:
        super().__init__()
        self.numbers = numbers
        height, width, channels = shape
        layers: list[nn.Module] = []
        for filters, kernel, stride in convolutions:
            if min(height, width) < kernel:
                raise ConfigError(
                    f"training.convolutions: a kernel of {kernel} is larger than planes of {height}×{width}"
                )
            layer = nn.Conv2d(channels, filters, kernel, stride)
            nn.init.orthogonal_(layer.weight, 2**0.5)
            nn.init.zeros_(layer.get_parameter("bias"))
            # The channels of an observation stand last, and so need not be moved in memory.
            layer.weight.data = layer.weight.data.to(memory_format=torch.channels_last)
            layers += [layer, nn.ReLU()]
            height, width, channels = (height - kernel) // stride + 1, (width - kernel) // stride + 1, filters
        self.convolutions = nn.Sequential(*layers, nn.Flatten())

    def forward(self, values: Tensor) -> Tensor:
        return self.convolutions(self.numbers(values).permute(0, 3, 1, 2))


def _part(space: gymnasium.Space, convolutions: Convolutions, normalize: bool) -> nn.Module:
    match space:
        case gymnasium.spaces.Discrete():
            return OneHot([int(space.start)], [int(space.n)])
        case gymnasium.spaces.MultiDiscrete():
            return OneHot(space.start.ravel().tolist(), space.nvec.ravel().tolist())
        case gymnasium.spaces.MultiBinary():
            return nn.Sequential(Cast(), nn.Flatten())
        case gymnasium.spaces.Box():
            numbers = _numbers(space, normalize)
            if convolutions and len(space.shape) == 3:
                return Planes(numbers, space.shape, convolutions)
            return nn.Sequential(numbers, nn.Flatten())
    raise ConfigError(f"training: a network has no input for observations of {space}")


def _numbers(space: gymnasium.spaces.Box, normalize: bool) -> nn.Module:
    if normalize and np.issubdtype(space.dtype, np.floating):
        return RunningNormalization(space.shape)
    low, high = space.low.astype(np.float64), space.high.astype(np.float64)
    with np.errstate(over="ignore"):
        spans = high - low
    if spans.size and spans.min() >= WIDE and spans.max() <= ABSURD:
        return Scaled(*(_compact(bound) for bound in (low, high)))
    return Cast()


def _compact(bound: np.ndarray) -> np.ndarray:
    """One number where all are equal."""
    return bound.flat[:1].reshape(()) if (bound == bound.flat[0]).all() else bound
