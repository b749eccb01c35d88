"""What reads an observation: features, then hidden layers. Several policies may share one."""

from collections.abc import Sequence

import gymnasium
from torch import Tensor, nn

from training.modules.features import Convolutions, Features


class Encoder(nn.Module):
    """ONNX input name → (B, …), to (B, width) float32. hidden: widths of the layers, ReLU behind each."""

    def __init__(
        self,
        space: gymnasium.spaces.Dict,
        hidden: Sequence[int],
        convolutions: Convolutions = (),
        normalize: bool = False,
    ) -> None:
        super().__init__()
        self.features = Features(space, convolutions, normalize)
        layers: list[nn.Module] = []
        self.width = self.features.width
        for width in hidden:
            layers += [linear(self.width, width, gain=2**0.5), nn.ReLU()]
            self.width = width
        self.hidden = nn.Sequential(*layers)

    def forward(self, observations: dict[str, Tensor]) -> Tensor:
        return self.hidden(self.features(observations))

    def update_statistics(self, observations: dict[str, Tensor]) -> None:
        """Take a batch into the running statistics of the observations, where they are kept."""
        self.features.update_statistics(observations)


def linear(inputs: int, outputs: int, gain: float) -> nn.Linear:
    """A layer with orthogonal weights and no bias to begin with."""
    layer = nn.Linear(inputs, outputs)
    nn.init.orthogonal_(layer.weight, gain)
    nn.init.zeros_(layer.bias)
    return layer
