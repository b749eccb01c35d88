"""Networks of users' code for tic-tac-toe, most of which are refused. A comment marks the line that is to be named."""

import random
from typing import Any

import gymnasium
import torch
from torch import Tensor, nn

from league.config.network import NetworkConfig

WIDTH = 8


class Good(nn.Module):
    def __init__(self, space: gymnasium.spaces.Dict, width: Any = WIDTH) -> None:
        super().__init__()
        self.width, self.names = width, set(space.keys())
        self.layer = nn.Linear(18, WIDTH)

    def forward(self, observations: dict[str, Tensor]) -> Any:  # width
        assert set(observations) == self.names
        return self.layer(observations["observation"].float().flatten(1))


class Branching(Good):
    def forward(self, observations: dict[str, Tensor]) -> Tensor:
        features = super().forward(observations)
        return features if features.sum() > 0 else -features  # Branching


class Decomposing(Good):
    def forward(self, observations: dict[str, Tensor]) -> Tensor:
        features = super().forward(observations)
        return torch.linalg.svdvals(features.unsqueeze(-1)) + features  # Decomposing


class Random(Good):
    def forward(self, observations: dict[str, Tensor]) -> Tensor:  # Random
        return super().forward(observations) + torch.rand(WIDTH)


class Drawn(Good):
    def forward(self, observations: dict[str, Tensor]) -> Tensor:  # Drawn
        return super().forward(observations) + random.random()


class Mixing(Good):
    def forward(self, observations: dict[str, Tensor]) -> Tensor:  # Mixing
        return super().forward(observations).softmax(dim=0)


class Raising(Good):
    def forward(self, observations: dict[str, Tensor]) -> Tensor:
        return super().forward(observations)[:, 99]  # Raising


class InPlace(Good):
    def forward(self, observations: dict[str, Tensor]) -> Tensor:  # InPlace
        features = super().forward(observations).exp()
        features += 1
        return features


class Paired(Good):
    def forward(self, observations: dict[str, Tensor]) -> Any:  # Paired
        return (super().forward(observations),) * 2


class Infinite(Good):
    def forward(self, observations: dict[str, Tensor]) -> Tensor:  # Infinite
        return super().forward(observations) / 0


class Unbuilt(Good):
    def __init__(self, space: gymnasium.spaces.Dict) -> None:
        raise KeyError("planes")  # Unbuilt


def no_module(space: gymnasium.spaces.Dict) -> int:
    return len(space)


def settings(name: str, **kwargs: Any) -> dict[str, Any]:
    """The key `network` of a configuration."""
    return NetworkConfig(entry_point=f"{__name__}:{name}", kwargs=kwargs).model_dump()
