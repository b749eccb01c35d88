"""Scales of a chart: from values to pixels, with round numbers to write beside them."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Scale:
    """low, high: values that come to lie at the pixels `start` and `end`."""

    low: float
    high: float
    start: float
    end: float

    def at(self, value: float) -> float:
        """The pixel of a value."""
        return self.start + (value - self.low) / (self.high - self.low) * (self.end - self.start)

    def ticks(self, about: int, whole: bool = False) -> list[float]:
        """Round numbers between low and high, about so many. whole: integers only."""
        step = _step((self.high - self.low) / about)
        if whole:
            step = max(1.0, step)
        first, last = math.ceil(self.low / step - 1e-9), math.floor(self.high / step + 1e-9)
        return [number * step for number in range(first, last + 1)]


def _step(rough: float) -> float:
    """The smallest of 1, 2 and 5 times a power of ten that is at least `rough`."""
    power = 10.0 ** math.floor(math.log10(rough))
    return next(factor * power for factor in (1, 2, 5, 10) if factor * power >= rough * (1 - 1e-9))


def padded(low: float, high: float, share: float = 0.06, least: float = 1.0) -> tuple[float, float]:
    """A little more room on both sides, and `least` at least in all."""
    room = max(share * (high - low), (least - (high - low)) / 2)
    return low - room, high + room


def apart(places: list[float], least: float) -> list[float]:
    """`places`, in their order, moved as little downwards as keeps neighbours `least` apart."""
    moved: dict[int, float] = {}
    last = -math.inf
    for index in sorted(range(len(places)), key=places.__getitem__):
        last = moved[index] = max(places[index], last + least)
    return [moved[index] for index in range(len(places))]
