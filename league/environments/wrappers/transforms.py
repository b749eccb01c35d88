"""Vectorised versions of SuperSuit's observation wrappers, with identical results.

Each transform processes the observations (k, …) of k agents. SuperSuit processes agents one by one and resizes grey
images as four float channels; for pistonball's twenty agents its wrappers double the time of a step.
"""

import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from supersuit.utils import agent_indicator
from supersuit.utils.basic_transforms.color_reduction import GRAYSCALE_WEIGHTS

from league.config.environment import WrapperConfig

CHANNELS = {"R": 0, "G": 1, "B": 2}


class UnsupportedWrapper(Exception):
    """A wrapper has no vectorised version, or not for these arguments and spaces. The message is a clause."""


class Transform(ABC):
    """Transforms a batch of observations. By default without state."""

    def reset(self, slots: NDArray) -> None:  # noqa: B027
        """Start the episodes of some slots. A slot is an agent of an environment: env · agents + agent."""

    def copy(self, source: NDArray, target: NDArray) -> None:  # noqa: B027
        """Replace the state of the slots `target` by that of `source`."""

    @abstractmethod
    def __call__(self, rows: NDArray, slots: NDArray) -> NDArray:
        """Transform observations (k, …) of the slots (k,). Returns a new array or a view."""


class Stateless(Transform):
    """A transform without state."""

    def __init__(self, function: Callable[[NDArray], NDArray]) -> None:
        self._function = function

    def __call__(self, rows: NDArray, slots: NDArray) -> NDArray:  # noqa: ARG002
        return self._function(rows)


class FrameStack(Transform):
    """Concatenates the last observations of each agent, newest last, initially zeros."""

    def __init__(self, slots: int, space: spaces.Box, size: int) -> None:
        """space: observation space with 1 to 3 dimensions; images without a channel axis get one."""
        shape = (*space.shape, 1) if len(space.shape) == 2 else space.shape
        self._add_axis = len(space.shape) == 2
        self._new = shape[-1]
        self._frames = np.zeros((slots, *shape[:-1], self._new * size), space.dtype)
        # Stacks of 2, 4 or 8 bytes are shifted as one integer, which is eight times faster.
        itemsize = self._frames.itemsize
        width = self._frames.shape[-1] * itemsize
        self._word = np.dtype(f"u{width}") if width in (2, 4, 8) and sys.byteorder == "little" else None
        self._bits = self._new * itemsize * 8

    def reset(self, slots: NDArray) -> None:
        self._frames[slots] = 0

    def copy(self, source: NDArray, target: NDArray) -> None:
        self._frames[target] = self._frames[source]

    def __call__(self, rows: NDArray, slots: NDArray) -> NDArray:
        frames = self._frames[slots]
        if self._word is not None and self._bits < self._word.itemsize * 8:
            words = frames.view(self._word)
            np.right_shift(words, np.array(self._bits, self._word), out=words)
        else:
            frames[..., : -self._new] = frames[..., self._new :]
        frames[..., -self._new :] = rows[..., np.newaxis] if self._add_axis else rows
        self._frames[slots] = frames
        return frames


class Resize(Transform):
    """Bilinear interpolation as in tinyscaler: in float32, rows first."""

    def __init__(self, height: int, width: int, to_height: int, to_width: int) -> None:
        self._rows, self._down = _axis(height, to_height)
        self._columns, self._across = _axis(width, to_width)

    def __call__(self, rows: NDArray, slots: NDArray) -> NDArray:  # noqa: ARG002
        """Resize images (k, height, width) or (k, height, width, channels) of uint8 or floats."""
        trailing = (1,) * (rows.ndim - 3)
        down, across = self._down.reshape(-1, 1, *trailing), self._across.reshape(-1, *trailing)
        tall = _unit(rows[:, self._rows]) * (1 - down) + _unit(rows[:, self._rows + 1]) * down
        small = tall[:, :, self._columns] * (1 - across) + tall[:, :, self._columns + 1] * across
        return (small * np.float32(255) if rows.dtype == np.uint8 else small).astype(rows.dtype)


class Indicator(Transform):
    """Appends a one-hot agent or agent-type indicator as numbers or channels, scaled to the maximum of the space."""

    def __init__(self, indicators: Mapping[str, int], space: spaces.Box) -> None:
        """space: observation space with 1 to 3 dimensions; images without a channel axis get one."""
        self._of_agent = np.array(list(indicators.values()))
        self._width = len(set(indicators.values()))
        self._add_axis = len(space.shape) == 2
        self._on = 1.0 if np.isinf(space.high).any() else np.max(space.high)

    def __call__(self, rows: NDArray, slots: NDArray) -> NDArray:
        if self._add_axis:
            rows = rows[..., np.newaxis]
        extended = np.zeros((*rows.shape[:-1], rows.shape[-1] + self._width), rows.dtype)
        extended[..., : rows.shape[-1]] = rows
        channels = self._of_agent[slots % len(self._of_agent)] + rows.shape[-1]
        extended[np.arange(len(rows)), ..., channels] = self._on
        return extended


def _unit(pixels: NDArray) -> NDArray:
    """Convert to float32; uint8 is scaled to [0, 1]."""
    floats = pixels.astype(np.float32)
    return floats * np.float32(1 / 255) if pixels.dtype == np.uint8 else floats


def _axis(before: int, after: int) -> tuple[NDArray, NDArray]:
    """For each new pixel, the index of the left old pixel and the weight of the right one."""
    ratio = np.float32(before - 1) / np.float32(after)
    position = (np.arange(after, dtype=np.float32) + np.float32(0.5)) * ratio
    left_pixels = position.astype(np.int32)
    return left_pixels, position - left_pixels.astype(np.float32)


def channel(mode: str = "full") -> Callable[[NDArray], NDArray] | None:
    """Return a function that selects a channel for `color_reduction_v0`; None if the mode needs a computation."""
    if mode not in CHANNELS:
        return None
    index = CHANNELS[mode]
    return lambda pixels: pixels[..., index]


def transform(
    wrapper: WrapperConfig,
    space: spaces.Space[Any],
    changed: spaces.Space[Any],
    agents: Sequence[str],
    num_envs: int = 1,
) -> Transform:
    """Return the vectorised version of a SuperSuit wrapper. Raises UnsupportedWrapper.

    Args:
        wrapper: The wrapper, with arguments validated by SuperSuit.
        space: Observation space of the agents whose observations are transformed.
        changed: The space after the wrapper.
        agents: All agents of the environment.
        num_envs: Number of environments.
    """
    kwargs = wrapper.kwargs
    if isinstance(space, spaces.Box) and isinstance(changed, spaces.Box):
        match wrapper.name:
            case "color_reduction_v0":
                grey = channel(**kwargs) or (
                    lambda rows: (rows.astype(np.float32) @ GRAYSCALE_WEIGHTS).astype(np.uint8)
                )
                return Stateless(grey)
            case "resize_v1" if (
                kwargs.get("linear_interp", True)
                and min(space.shape[:2]) >= 2
                and space.dtype in (np.uint8, np.float32)
            ):
                return Resize(space.shape[0], space.shape[1], kwargs["y_size"], kwargs["x_size"])
            case "frame_stack_v1" if kwargs.get("stack_dim", -1) == -1:
                return FrameStack(num_envs * len(agents), space, kwargs.get("stack_size", 4))
            case "agent_indicator_v0":
                return Indicator(agent_indicator.get_indicator_map(agents, kwargs.get("type_only", False)), space)
            case "pad_observations_v0":
                # Zeros are appended until each observation has the new shape.
                missing = [(0, new - old) for new, old in zip(changed.shape, space.shape, strict=True)]
                is_equal = changed.shape == space.shape
                return Stateless(lambda rows: rows if is_equal else np.pad(rows, [(0, 0), *missing]))
            case "dtype_v0":
                return Stateless(lambda rows: rows.astype(kwargs["dtype"]))
            case "flatten_v0":
                return Stateless(lambda rows: rows.reshape(len(rows), -1))
            case "reshape_v0":
                return Stateless(lambda rows: rows.reshape(len(rows), *kwargs["shape"]))
            case "normalize_obs_v0":
                low, size, to_low = space.low, space.high - space.low, float(kwargs.get("env_min", 0.0))
                to_size = float(kwargs.get("env_max", 1.0)) - to_low
                return Stateless(lambda rows: (rows - low) / size * to_size + to_low)
    raise UnsupportedWrapper(
        f"wrapper {wrapper.name} has no vectorised version for its arguments and observations in {space}"
    )
