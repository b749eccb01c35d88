"""Observations in the environment's dtype → one row of float32 each."""

from collections.abc import Sequence

import gymnasium
import torch
from torch import Tensor, nn
from torch.nn import functional

from league.errors import ConfigError
from league.spaces import ACTION_MASK


class Features(nn.Module):
    """Concatenates all parts of an observation but the action mask.

    Box and MultiBinary are flattened, Discrete and MultiDiscrete become one-hot. A Box of planes, (height, width,
    channels), passes through the convolutions first: (filters, kernel) each, without padding, ReLU behind each.
    Input: ONNX input name → (B, …). Output: (B, width) float32. Raises ConfigError if the convolutions do not fit.
    """

    def __init__(self, space: gymnasium.spaces.Dict, convolutions: Sequence[tuple[int, int]] = ()) -> None:
        super().__init__()
        self._parts = [(name, part) for name, part in sorted(space.spaces.items()) if name != ACTION_MASK]
        planes = {name: part for name, part in self._parts if convolutions and _is_planes(part)}
        if convolutions and not planes:
            raise ConfigError("training.convolutions: no part of the observation is a Box of (height, width, channels)")
        # Names may hold dots, which torch's ModuleDict refuses.
        self._stack_of = {name: index for index, name in enumerate(planes)}
        self._stacks = nn.ModuleList(_stack(part.shape, convolutions) for part in planes.values())
        with torch.no_grad():
            example = {name: torch.as_tensor(part.sample())[None] for name, part in self._parts}
            self.width = self(example).shape[-1]

    def forward(self, observations: dict[str, Tensor]) -> Tensor:
        rows = [self._row(name, part, observations[name]) for name, part in self._parts]
        return rows[0] if len(rows) == 1 else torch.cat(rows, dim=-1)

    def _row(self, name: str, part: gymnasium.Space, value: Tensor) -> Tensor:
        if name in self._stack_of:
            return self._stacks[self._stack_of[name]](value.permute(0, 3, 1, 2).float())
        return _flat(value, part)


def _is_planes(space: gymnasium.Space) -> bool:
    return isinstance(space, gymnasium.spaces.Box) and len(space.shape) == 3


def _stack(shape: tuple[int, ...], convolutions: Sequence[tuple[int, int]]) -> nn.Sequential:
    height, width, channels = shape
    layers: list[nn.Module] = []
    for filters, kernel in convolutions:
        if min(height, width) < kernel:
            raise ConfigError(f"training.convolutions: a kernel of {kernel} is larger than planes of {height}×{width}")
        layer = nn.Conv2d(channels, filters, kernel)
        nn.init.orthogonal_(layer.weight, 2**0.5)
        nn.init.zeros_(layer.get_parameter("bias"))
        layers += [layer, nn.ReLU()]
        height, width, channels = height - kernel + 1, width - kernel + 1, filters
    return nn.Sequential(*layers, nn.Flatten())


def _flat(value: Tensor, space: gymnasium.Space) -> Tensor:
    match space:
        case gymnasium.spaces.Discrete():
            return _one_hot(value, int(space.start), int(space.n))
        case gymnasium.spaces.MultiDiscrete():
            columns = zip(space.start.flat, space.nvec.flat, strict=True)
            flat = value.flatten(1)
            parts = [_one_hot(flat[:, i], int(start), int(n)) for i, (start, n) in enumerate(columns)]
            return torch.cat(parts, dim=-1)
        case gymnasium.spaces.Box() | gymnasium.spaces.MultiBinary():
            return value.flatten(1).float()
    raise ConfigError(f"training: a network has no input for observations of {space}")


def _one_hot(value: Tensor, start: int, n: int) -> Tensor:
    return functional.one_hot((value - start).long(), n).float()
