"""The value of what agents do: of all of them, or of one alone. It exists while learning only; no graph holds one."""

from collections.abc import Sequence

import gymnasium
import torch
from torch import Tensor, nn

from training.modules.encoder import linear
from training.modules.features import Convolutions, Features
from training.modules.relaxed import relaxed


class Critic(nn.Module):
    """Q(o_1 … o_k, a_1 … a_k): hidden layers over the features of all observations and over all actions."""

    def __init__(
        self,
        observations: Sequence[gymnasium.spaces.Dict],
        actions: Sequence[gymnasium.Space],
        hidden: Sequence[int],
        convolutions: Convolutions = (),
        normalize: bool = False,
    ) -> None:
        """The spaces of the k agents, observations as Dicts ONNX input name → part. hidden: widths, ReLU behind each;
        convolutions, normalize: see Features."""
        super().__init__()
        observed = [Features(space, convolutions, normalize) for space in observations]
        self.observed = nn.ModuleList(observed)
        layers: list[nn.Module] = []
        width = sum(part.width for part in observed) + sum(relaxed(space).width for space in actions)
        for wide in hidden:
            layers += [linear(width, wide, gain=2**0.5), nn.ReLU()]
            width = wide
        self.value = nn.Sequential(*layers, linear(width, 1, gain=1.0))

    def forward(self, observations: Sequence[dict[str, Tensor]], actions: Sequence[Tensor]) -> Tensor:
        """k observations, ONNX input name → (B, …), and k actions (B, width), as critics take them → (B,)."""
        rows = [part(observed) for part, observed in zip(self.observed, observations, strict=True)]
        return self.value(torch.cat([*rows, *actions], dim=-1)).squeeze(-1)

    def update_statistics(self, observations: Sequence[dict[str, Tensor]]) -> None:
        """Take a batch into the running statistics of the observations, where they are kept."""
        for part, observed in zip(self.observed, observations, strict=True):
            assert isinstance(part, Features)
            part.update_statistics(observed)
