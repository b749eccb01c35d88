"""The optimiser of all learners: Adam, with clipped gradients, that never waits for a GPU."""

import logging
from collections.abc import Iterable, Mapping
from typing import Any

import torch
from torch import Tensor, nn

from league.errors import InvalidInput
from training.rllib_compat import fused_adam

logger = logging.getLogger(__name__)


class ClippedAdam(torch.optim.Adam):
    """Adam on gradients that are clipped by their global norm.

    Weights, gradients and moments are one vector each, so that a step is a few operations, however many parameters
    there are. The parameters and their states are views of these vectors.

    A gradient that is not finite changes neither weights nor moments. What torch offers for mixed precision decides
    this on the parameters' device: the fused step divides gradients by `grad_scale`, and does nothing if `found_inf`.
    """

    def __init__(self, parameters: Iterable[nn.Parameter], *, lr: float, max_norm: float, eps: float = 1e-8) -> None:
        super().__init__(parameters, lr=lr, eps=eps, fused=True)
        self.max_norm = max_norm
        (group,) = self.param_groups
        self._parameters: list[nn.Parameter] = group["params"]
        # A vector keeps the order of each parameter's elements in memory; None: that of its axes.
        self._axes = [
            None if parameter.is_contiguous() else sorted(range(parameter.ndim), key=parameter.stride, reverse=True)
            for parameter in self._parameters
        ]
        self._weights = torch.cat(self._flat([parameter.detach() for parameter in self._parameters]))
        self._gradients, self._means, self._squares = (torch.zeros_like(self._weights) for _ in range(3))
        self._count, self._dropped = (torch.zeros((), device=self._weights.device) for _ in range(2))
        for parameter, weights in zip(self._parameters, self._views(self._weights), strict=True):
            parameter.data = weights
        self._set_state()

    def step(self, closure: Any = None) -> Any:
        """Raise NotImplementedError: only `clip_and_step` updates the parameters."""
        raise NotImplementedError("gradients are clipped at each step: call clip_and_step")

    @torch.no_grad()
    def clip_and_step(self) -> Tensor:
        """Update the parameters, drop their gradients, and return the norm of these before clipping.

        The gradient of a parameter that has none is 0.
        """
        gradients = [torch.zeros_like(p) if p.grad is None else p.grad for p in self._parameters]
        torch.cat(self._flat(gradients), out=self._gradients)
        for parameter in self._parameters:
            parameter.grad = None
        norm = torch.linalg.vector_norm(self._gradients)
        found_inf = (norm * 0).nan_to_num_(nan=1.0)
        self._dropped += found_inf
        self._count += 1 - found_inf
        (group,) = self.param_groups
        beta1, beta2 = group["betas"]
        fused_adam(
            *([self._weights], [self._gradients], [self._means], [self._squares], [], [self._count]),
            grad_scale=(norm / self.max_norm).clamp_(min=1.0),
            found_inf=found_inf,
            amsgrad=False,
            beta1=beta1,
            beta2=beta2,
            lr=group["lr"],
            weight_decay=0.0,
            eps=group["eps"],
            maximize=False,
        )
        return norm

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Load what `state_dict` returned, of any version of torch's Adam with the same parameters."""
        super().load_state_dict(state_dict)
        loaded = [self.state[parameter] for parameter in self._parameters if parameter in self.state]
        for key, vector in (("exp_avg", self._means), ("exp_avg_sq", self._squares)):
            vector.copy_(torch.cat(self._flat([state[key] for state in loaded]))) if loaded else vector.zero_()
        self._count.fill_(loaded[0]["step"] if loaded else 0.0)
        self._set_state()

    def _set_state(self) -> None:
        moments = zip(self._parameters, self._views(self._means), self._views(self._squares), strict=True)
        for parameter, mean, square in moments:
            self.state[parameter] = {"step": self._count, "exp_avg": mean, "exp_avg_sq": square}

    def _flat(self, tensors: Iterable[Tensor]) -> list[Tensor]:
        """Return one vector per parameter."""
        return [
            (tensor if axes is None else tensor.permute(axes)).reshape(-1)
            for tensor, axes in zip(tensors, self._axes, strict=True)
        ]

    def _views(self, vector: Tensor) -> list[Tensor]:
        """Return one view per parameter, with its shape and strides."""
        parts = vector.split([parameter.numel() for parameter in self._parameters])
        return [
            part.as_strided(parameter.shape, parameter.stride(), part.storage_offset())
            for part, parameter in zip(parts, self._parameters, strict=True)
        ]

    @property
    def has_stepped(self) -> bool:
        """Whether a gradient has ever been finite."""
        return bool(self._count)

    def take_dropped(self) -> int:
        """Return the number of gradients that were not finite since the last call."""
        dropped = int(self._dropped)
        self._dropped.zero_()
        return dropped


def check_gradients(optimizers: Mapping[str, ClippedAdam]) -> None:
    """Log the names of optimisers whose gradients were not finite since the last call.

    Raises InvalidInput for one that has had no other: its network learns nothing, although a run would go on.
    """
    for name, optimizer in optimizers.items():
        if dropped := optimizer.take_dropped():
            if not optimizer.has_stepped:
                raise InvalidInput(
                    f"training: all {dropped} gradients of {name} are not finite: observations, rewards or outputs of"
                    " its network are too large; `league check-env` names such observations: scale them, or set"
                    " training.normalize_observations"
                )
            logger.warning("Dropped a non-finite gradient of %s: %d in this update.", name, dropped)
