"""Several policies that read their observations with one encoder, and act with heads of their own."""

from typing import Any

import torch
from ray.rllib.core.columns import Columns
from ray.rllib.core.rl_module.multi_rl_module import MultiRLModule
from torch import Tensor

from league.spaces import ACTION_MASK
from training.modules.encoder import Encoder


class SharedEncoder(MultiRLModule):
    """ActorCritics whose `encoder` is one object, which runs once per pass for the rows of all policies together.

    Each of them stands alone as well: `module[policy]` acts, saves, and is exported with the encoder inside.
    All must observe the same space, action masks apart.
    """

    def setup(self) -> None:
        super().setup()
        modules = list(self._rl_modules.values())
        for module in modules[1:]:
            module.encoder = modules[0].encoder

    @property
    def encoder(self) -> Encoder:
        """The one of all policies."""
        return next(iter(self._rl_modules.values())).encoder

    def _forward_train(self, batch: dict[str, Any], **_: Any) -> dict[str, dict[str, Tensor]]:
        return {
            policy: self._rl_modules[policy].heads(embeddings, batch[policy][Columns.OBS])
            for policy, embeddings in self._encoded(batch).items()
        }

    def _forward(self, batch: dict[str, Any], **_: Any) -> dict[str, dict[str, Tensor]]:
        with torch.no_grad():
            return {
                policy: self._rl_modules[policy].act(embeddings, batch[policy][Columns.OBS])
                for policy, embeddings in self._encoded(batch).items()
            }

    _forward_inference = _forward
    _forward_exploration = _forward

    def _encoded(self, batch: dict[str, Any]) -> dict[str, Tensor]:
        """Policy id → embeddings of its rows."""
        observed = {policy: columns[Columns.OBS] for policy, columns in batch.items() if policy in self}
        if not observed:
            return {}
        rows = [len(next(iter(observations.values()))) for observations in observed.values()]
        together = {
            name: torch.cat([observations[name] for observations in observed.values()])
            for name in next(iter(observed.values()))
            if name != ACTION_MASK
        }
        return dict(zip(observed, self.encoder(together).split(rows), strict=True))
