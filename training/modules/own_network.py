"""A network of the user's code in place of the encoder. docs/extending.md describes the interface for authors."""

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
import torch
from torch import Tensor, nn

from league.entry_points import import_entry_point
from league.errors import ConfigError, cause, no_exit
from league.spaces import ACTION_MASK
from training.modules.encoder import RunningNormalization, rounds_factors

NETWORK = "training.network"


class OwnNetwork(nn.Module):
    """ONNX input name → (B, …), without the action mask, to the features of the user's network, (B, width) float32.

    normalize: normalise Boxes of floats by running statistics before the network gets them. Raises ConfigError if the
    network cannot be created or declares no `width`.
    """

    def __init__(
        self, entry_point: str, kwargs: Mapping[str, Any], space: gymnasium.spaces.Dict, normalize: bool = False
    ) -> None:
        super().__init__()
        spaces = {name: part for name, part in sorted(space.spaces.items()) if name != ACTION_MASK}
        make = import_entry_point(NETWORK, entry_point)
        try:
            with no_exit:
                network = make(gymnasium.spaces.Dict(spaces), **kwargs)
        except Exception as error:
            raise ConfigError(f"{NETWORK}: {entry_point} cannot be created{cause(error)}") from error
        if not isinstance(network, nn.Module):
            raise ConfigError(f"{NETWORK}: {entry_point} returned a {type(network).__name__}, expected an nn.Module")
        width = getattr(network, "width", None)
        if not isinstance(width, int) or width < 1:
            raise ConfigError(
                f"{NETWORK}: {entry_point} has the width {width!r}, expected the number of its features as an int"
            )
        self.network, self.width, self.names = network, width, tuple(spaces)
        # A list, since names may contain dots, which torch's ModuleDict rejects.
        self.inputs = nn.ModuleList(
            RunningNormalization(part.shape)
            if normalize and isinstance(part, gymnasium.spaces.Box) and np.issubdtype(part.dtype, np.floating)
            else nn.Identity()
            for part in spaces.values()
        )

    def forward(self, observations: dict[str, Tensor]) -> Tensor:
        inputs = {name: part(observations[name]) for name, part in zip(self.names, self.inputs, strict=True)}
        if rounds_factors():
            with torch.autocast("cpu", dtype=torch.bfloat16):
                return self.network(inputs).float()
        return self.network(inputs)

    def update_statistics(self, observations: dict[str, Tensor], counted: Tensor | None = None) -> None:
        """Update the running statistics of the observations, if normalised.

        counted: see `RunningNormalization.update`.
        """
        for name, part in zip(self.names, self.inputs, strict=True):
            if isinstance(part, RunningNormalization):
                part.update(observations[name], counted)
