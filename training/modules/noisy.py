"""A linear layer with noise in its weights: Fortunato et al., 2018, "Noisy networks for exploration", 1706.10295."""

import torch
from torch import Tensor, nn

INITIAL_DEVIATION = 0.5
"""σ₀ of section 3.2."""


class NoisyLinear(nn.Module):
    """y = (μ_w + σ_w ε_w) x + μ_b + σ_b ε_b with factorised noise, equations 9 to 11: ε_w = f(ε_out) f(ε_in)ᵀ and
    ε_b = f(ε_out), f(x) = sgn(x) √|x|. Without noise, ε = 0."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.inputs, self.outputs = inputs, outputs
        bound = inputs**-0.5
        self.weight = nn.Parameter(torch.empty(outputs, inputs).uniform_(-bound, bound))
        self.bias = nn.Parameter(torch.empty(outputs).uniform_(-bound, bound))
        self.weight_deviation = nn.Parameter(torch.full((outputs, inputs), INITIAL_DEVIATION * bound))
        self.bias_deviation = nn.Parameter(torch.full((outputs,), INITIAL_DEVIATION * bound))

    def forward(self, x: Tensor, noise: bool = False) -> Tensor:
        """(B, inputs) → (B, outputs). noise: fresh, the same for all rows."""
        if not noise:
            return nn.functional.linear(x, self.weight, self.bias)
        incoming, outgoing = (_scaled(torch.randn(size, device=x.device)) for size in (self.inputs, self.outputs))
        weight = self.weight + self.weight_deviation * torch.outer(outgoing, incoming)
        return nn.functional.linear(x, weight, self.bias + self.bias_deviation * outgoing)


def _scaled(noise: Tensor) -> Tensor:
    return noise.sign() * noise.abs().sqrt()
