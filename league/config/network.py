"""Layers of a policy network."""

from collections.abc import Sequence
from typing import Literal

from pydantic import Field

from league.config.base import JSON, EntryPoint, Part

Channels = Literal["first", "last"]
"""The axis of the channels of images: (channels, height, width) or (height, width, channels)."""


def channels_of(shape: Sequence[int]) -> Channels:
    """Return the axis of the channels of images with a shape: the first one if both others are at least twice as long.

    Boards have few rows and many planes, so a first axis that is only a little shorter are rows.
    """
    first, *other_lengths = shape
    return "first" if 2 * first <= min(other_lengths) else "last"


class ConvolutionConfig(Part):
    """A convolution without padding over image-like observations."""

    filters: int = Field(ge=1)
    kernel: int = Field(default=3, ge=1)
    stride: int = Field(default=1, ge=1)


class NetworkConfig(Part):
    """A network of the user's code, in place of the convolutions and hidden layers."""

    entry_point: EntryPoint
    """A subclass of torch.nn.Module, or a function that returns one."""
    kwargs: JSON = Field(default={})
    """Its keyword arguments, after the observation space."""


class RecurrenceConfig(Part):
    """An LSTM between the hidden layers and the heads (Hochreiter and Schmidhuber, 1997)."""

    width: int = Field(default=128, ge=1)
    sequence: int = Field(default=20, ge=1)
    """Steps of truncated backpropagation through time."""


class GatedRecurrenceConfig(Part):
    """A GRU before the head (Cho et al., 2014, arXiv 1406.1078), whose input includes the previous action."""

    width: int = Field(default=64, ge=1)
    sequence: int = Field(default=50, ge=1)
    """Length of training sequences. Longer episodes are split at its multiples; each part starts from the recurrent
    state recorded during sampling."""
