"""Observations shifted and scaled by their own running mean and deviation."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

SMALLEST_VARIANCE = 1e-8
LARGEST = 10.0
"""Deviations from the mean, in standard deviations, beyond which values are clipped."""


class RunningNormalization(nn.Module):
    """Mean and variance of each number of an array, as buffers: they are part of the weights, and of the graph.

    Before the first `update` it leaves values as they are, but for the clipping.
    """

    count: Tensor
    mean: Tensor
    variance: Tensor

    def __init__(self, shape: Sequence[int]) -> None:
        super().__init__()
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))
        # Doubles: of numbers far from 0, a float's rounding would be taken for their deviation.
        self.register_buffer("mean", torch.zeros(*shape, dtype=torch.float64))
        self.register_buffer("variance", torch.ones(*shape, dtype=torch.float64))

    def forward(self, values: Tensor) -> Tensor:
        """(B, *shape) → the same in float32."""
        scaled = (values - self.mean) * torch.rsqrt(self.variance + SMALLEST_VARIANCE)
        return scaled.clamp(-LARGEST, LARGEST).float()

    @torch.no_grad()
    def update(self, values: Tensor) -> None:
        """Take in a batch (B, *shape).

        Chan, Golub and LeVeque, 1979, "Updating formulae and a pairwise algorithm for computing sample variances":
        with δ the difference of the two means, M = M_a + M_b + δ² n_a n_b / n.
        """
        values, seen = values.double(), len(values)
        total = self.count + seen
        delta = values.mean(0) - self.mean
        squares = self.variance * self.count + values.var(0, correction=0) * seen
        squares += delta.square() * self.count * seen / total
        self.mean += delta * seen / total
        self.variance.copy_(squares / total)
        self.count.copy_(total)
