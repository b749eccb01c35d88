"""Observation encoders: dense, convolutional and nested, with input normalisation.

Each part of an observation is converted to float32: integers become one-hot, boxes with wide finite bounds, such as 0
to 255 for images, are scaled to [0, 1], and other numbers are taken as they are.
"""

from collections.abc import Sequence

import gymnasium
import numpy as np
import torch
from torch import Tensor, nn

from league.config.network import Channels, channels_of
from league.errors import ConfigError
from league.spaces import ACTION_MASK

MIN_VARIANCE = 1e-8
MAX_DEVIATIONS = 10.0
"""Values are clipped at this many standard deviations from the mean."""


class RunningNormalization(nn.Module):
    """Normalises by the running mean and variance of each element.

    They are buffers: part of the weights and of the graph.

    Before the first `update`, values are only clipped.
    """

    count: Tensor
    mean: Tensor
    variance: Tensor

    def __init__(self, shape: Sequence[int]) -> None:
        super().__init__()
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))
        # Doubles: far from 0, float32 rounding would dominate the deviations.
        self.register_buffer("mean", torch.zeros(shape, dtype=torch.float64))
        self.register_buffer("variance", torch.ones(shape, dtype=torch.float64))

    def forward(self, values: Tensor) -> Tensor:
        """(B, *shape) → (B, *shape) float32."""
        scaled = (values - self.mean) * torch.rsqrt(self.variance + MIN_VARIANCE)
        return scaled.clamp(-MAX_DEVIATIONS, MAX_DEVIATIONS).float()

    @torch.no_grad()
    def update(self, values: Tensor, counted: Tensor | None = None) -> None:
        """Add a batch (B, *shape), or the rows of it that are `counted`, (B,) bool.

        Chan, Golub and LeVeque, 1979, "Updating formulae and a pairwise algorithm for computing sample variances":
        with δ the difference of the two means, M = M_a + M_b + δ² n_a n_b / n.
        """
        values = values.double()
        batch_size: int | Tensor
        if counted is None:
            batch_size, mean, variance = len(values), values.mean(0), values.var(0, correction=0)
        else:
            # Sums of all rows, since the size of a selection would have to be read from a GPU.
            batch_size = counted.sum()
            shares = (counted.double() / batch_size.clamp(min=1)).view(-1, *[1] * (values.ndim - 1))
            mean = (shares * values).sum(0)
            variance = (shares * (values - mean).square()).sum(0)
        total = (self.count + batch_size).clamp(min=1)
        delta = mean - self.mean
        squares = self.variance * self.count + variance * batch_size
        squares += delta.square() * self.count * batch_size / total
        self.mean += delta * batch_size / total
        self.variance.copy_(squares / total)
        self.count.copy_(total)


MIN_SCALED_SPAN, MAX_SCALED_SPAN = 100.0, 1e6
"""A Box is scaled if all spans between its bounds are in this range; wider bounds say nothing about its values."""

Convolutions = Sequence[tuple[int, int, int]]
"""(filters, kernel, stride) each, without padding."""


class ObservationFeatures(nn.Module):
    """Concatenates all parts of an observation except the action mask: ONNX input name → (B, …), to (B, width) float32.

    A Box with three axes is an image. It passes through the convolutions, each followed by ReLU; others are flattened.
    channels: the axis of its channels; None: see `channels_of`. normalize: scale boxes of floats by running statistics
    instead of their bounds. Raises ConfigError if the convolutions do not fit.
    """

    def __init__(
        self,
        space: gymnasium.spaces.Dict,
        convolutions: Convolutions = (),
        normalize: bool = False,
        channels: Channels | None = None,
    ) -> None:
        super().__init__()
        spaces = {name: part for name, part in sorted(space.spaces.items()) if name != ACTION_MASK}
        self.names = tuple(spaces)
        # A list, since names may contain dots, which torch's ModuleDict rejects.
        self.parts = nn.ModuleList(_feature(part, convolutions, normalize, channels) for part in spaces.values())
        if convolutions and not any(isinstance(part, ImageEncoder) for part in self.parts):
            raise ConfigError("training.convolutions: no part of the observation is a Box with three axes")
        with torch.no_grad():
            example = {name: torch.as_tensor(np.zeros((1, *part.shape), part.dtype)) for name, part in spaces.items()}
            self.width = self(example).shape[-1]

    def forward(self, observations: dict[str, Tensor]) -> Tensor:
        rows = [part(observations[name]) for name, part in zip(self.names, self.parts, strict=True)]
        return rows[0] if len(rows) == 1 else torch.cat(rows, dim=-1)

    def update_statistics(self, observations: dict[str, Tensor], counted: Tensor | None = None) -> None:
        """Update the running statistics of the parts that have them. counted: see `RunningNormalization.update`."""
        for name, part in zip(self.names, self.parts, strict=True):
            for layer in part.modules():
                if isinstance(layer, RunningNormalization):
                    layer.update(observations[name], counted)


class OneHot(nn.Module):
    """Integers (B, …), element i in [starts[i], starts[i] + sizes[i]) → (B, sum of sizes)."""

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


class UnitScale(nn.Module):
    """Scales [low, high] to [0, 1]."""

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


class ToFloat(nn.Module):
    """Converts to float32."""

    def forward(self, values: Tensor) -> Tensor:
        return values.float()


class Flat(nn.Flatten):
    """(B, …) → (B, width); (B,) → (B, 1)."""

    def forward(self, values: Tensor) -> Tensor:
        return super().forward(values) if values.ndim > 1 else values.unsqueeze(1)


SMALL_IMAGE = 100
"""Pixels of the largest images, such as boards of games, whose convolutions are computed as products of patches."""


class ImageEncoder(nn.Module):
    """Images (B, height, width, channels) or (B, channels, height, width) → convolutions → (B, width).

    With gradients, convolutions of small images are matrix products on the CPU: libraries optimise convolutions for
    many channels. Only kernels of one pixel and stride 1 may follow the first layer: others would scatter gradients.
    """

    def __init__(
        self, numbers: nn.Module, shape: tuple[int, ...], convolutions: Convolutions, channels_axis: Channels
    ) -> None:
        super().__init__()
        self.numbers, self._is_first = numbers, channels_axis == "first"
        height, width, channels = (*shape[1:], shape[0]) if self._is_first else shape
        self._is_small = height * width <= SMALL_IMAGE and all(
            kernel == stride == 1 for _, kernel, stride in convolutions[1:]
        )
        layers: list[nn.Module] = []
        for filters, kernel, stride in convolutions:
            if min(height, width) < kernel:
                raise ConfigError(f"training.convolutions: kernel {kernel} is larger than images of {height}×{width}")
            layer = nn.Conv2d(channels, filters, kernel, stride)
            nn.init.orthogonal_(layer.weight, 2**0.5)
            nn.init.zeros_(layer.get_parameter("bias"))
            if not self._is_first:
                # This layout avoids moving the observations in memory.
                layer.weight.data = layer.weight.data.to(memory_format=torch.channels_last)
            layers += [layer, nn.ReLU(inplace=True)]
            height, width, channels = (height - kernel) // stride + 1, (width - kernel) // stride + 1, filters
        self.convolutions = nn.Sequential(*layers, nn.Flatten())

    def forward(self, values: Tensor) -> Tensor:
        numbers = self.numbers(values)
        if self._is_small and numbers.is_cpu and torch.is_grad_enabled() and not torch.compiler.is_exporting():
            return self._products(numbers.permute(0, 2, 3, 1) if self._is_first else numbers)
        return self.convolutions(numbers if self._is_first else numbers.permute(0, 3, 1, 2))

    def _products(self, images: Tensor) -> Tensor:
        """Compute the convolutions of images (B, height, width, channels)."""
        first, *layers = (layer for layer in self.convolutions if isinstance(layer, nn.Conv2d))
        (kernel, _), (stride, _) = first.kernel_size, first.stride
        patches = images.unfold(1, kernel, stride).unfold(2, kernel, stride).permute(0, 1, 2, 4, 5, 3).flatten(3)
        pixels = _product(patches.flatten(0, 2), first)
        for layer in layers:
            pixels = _product(pixels.relu_(), layer)
        # ReLU last: its gradient is slow in another layout than its result.
        return pixels.unflatten(0, patches.shape[:3]).permute(0, 3, 1, 2).flatten(1).relu_()


def _product(patches: Tensor, layer: nn.Conv2d) -> Tensor:
    """(n, kernel · kernel · channels) → (n, filters)."""
    return nn.functional.linear(patches, layer.weight.permute(0, 2, 3, 1).flatten(1), layer.bias)


def _feature(
    space: gymnasium.Space, convolutions: Convolutions, normalize: bool, channels: Channels | None
) -> nn.Module:
    match space:
        case gymnasium.spaces.Discrete():
            return OneHot([int(space.start)], [int(space.n)])
        case gymnasium.spaces.MultiDiscrete():
            return OneHot(space.start.ravel().tolist(), space.nvec.ravel().tolist())
        case gymnasium.spaces.MultiBinary():
            return nn.Sequential(ToFloat(), Flat())
        case gymnasium.spaces.Box():
            low, high = space.low.astype(np.float64), space.high.astype(np.float64)
            with np.errstate(over="ignore"):
                spans = high - low
            numbers: nn.Module = ToFloat()
            if normalize and np.issubdtype(space.dtype, np.floating):
                numbers = RunningNormalization(space.shape)
            elif spans.size and spans.min() >= MIN_SCALED_SPAN and spans.max() <= MAX_SCALED_SPAN:
                # A scalar if all elements are equal.
                scaled = (bound.flat[0] if (bound == bound.flat[0]).all() else bound for bound in (low, high))
                numbers = UnitScale(*scaled)
            if convolutions and len(space.shape) == 3:
                return ImageEncoder(numbers, space.shape, convolutions, channels or channels_of(space.shape))
            return nn.Sequential(numbers, Flat())
    raise ConfigError(f"training: unsupported observation space {space}")


class Encoder(nn.Module):
    """ONNX input name → (B, …), to (B, width) float32. hidden: widths of the layers, each followed by ReLU."""

    def __init__(
        self,
        space: gymnasium.spaces.Dict,
        hidden: Sequence[int],
        convolutions: Convolutions = (),
        normalize: bool = False,
        channels: Channels | None = None,
    ) -> None:
        super().__init__()
        self.features = ObservationFeatures(space, convolutions, normalize, channels)
        layers: list[nn.Module] = []
        self.width = self.features.width
        for width in hidden:
            layers += [linear(self.width, width, gain=2**0.5), nn.ReLU(inplace=True)]
            self.width = width
        self.hidden = nn.Sequential(*layers)

    def forward(self, observations: dict[str, Tensor]) -> Tensor:
        if rounds_factors():
            with torch.autocast("cpu", dtype=torch.bfloat16):
                return self.hidden(self.features(observations)).float()
        return self.hidden(self.features(observations))

    def update_statistics(self, observations: dict[str, Tensor], counted: Tensor | None = None) -> None:
        """Update the running statistics of the observations, if normalised.

        counted: see `RunningNormalization.update`.
        """
        self.features.update_statistics(observations, counted)


def rounds_factors() -> bool:
    """Return whether encoders round the factors of their products to bfloat16: in a gradient step on the CPU.

    Without AMX, oneDNN does not round factors itself. Sums are float32, and rounded as the next factors.
    """
    return torch.backends.mkldnn.matmul.fp32_precision == "bf16" and has_bfloat16()  # type: ignore[attr-defined]


def has_bfloat16() -> bool:
    """Return whether the processor multiplies bfloat16, which it does about twice as fast as float32."""
    return bool(torch.cpu.get_capabilities().get("avx512_bf16", False))


def linear(inputs: int, outputs: int, gain: float) -> nn.Linear:
    """Create a layer with orthogonal weights and zero bias."""
    layer = nn.Linear(inputs, outputs)
    nn.init.orthogonal_(layer.weight, gain)
    nn.init.zeros_(layer.bias)
    return layer
