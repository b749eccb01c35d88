"""The optimiser of all learners: Adam, with clipped gradients, that never waits for a GPU."""

import logging
from collections.abc import Iterable, Mapping

import torch
from torch import Tensor, nn

logger = logging.getLogger(__name__)

MIN_NORM = 1e-6
"""Added to norms, as in `torch.nn.utils.clip_grad_norm_`."""


class ClippedAdam(torch.optim.Adam):
    """Adam on gradients that are clipped by their global norm.

    A gradient that is not finite changes neither weights nor moments. What torch offers for mixed precision decides
    this on the parameters' device: the fused step divides gradients by `grad_scale`, and does nothing if `found_inf`.
    """

    def __init__(self, parameters: Iterable[nn.Parameter], *, lr: float, max_norm: float, eps: float = 1e-8) -> None:
        super().__init__(parameters, lr=lr, eps=eps, fused=True)
        self.max_norm = max_norm
        self._dropped: list[Tensor] = []

    def clip_and_step(self) -> Tensor:
        """Update the parameters, and return the norm of their gradients before clipping."""
        gradients = [
            parameter.grad for group in self.param_groups for parameter in group["params"] if parameter.grad is not None
        ]
        norm = torch.nn.utils.get_total_norm(gradients)
        self.grad_scale = ((norm + MIN_NORM) / self.max_norm).clamp(min=1.0)
        self.found_inf = (~norm.isfinite()).float()
        self._dropped.append(self.found_inf)
        self.step()
        return norm

    def take_dropped(self) -> int:
        """Return the number of gradients that were not finite since the last call."""
        dropped, self._dropped = self._dropped, []
        return int(torch.stack(dropped).sum()) if dropped else 0


def warn_of_dropped_gradients(optimizers: Mapping[str, ClippedAdam]) -> None:
    """Log the names of optimisers whose gradients were not finite since the last call."""
    for name, optimizer in optimizers.items():
        if dropped := optimizer.take_dropped():
            logger.warning("Dropped a non-finite gradient of %s: %d in this update.", name, dropped)
