"""The contract of a policy: observation (+ mask, + state) → action, batched, without hidden state."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Arrays = Mapping[str, NDArray]
"""ONNX input or output name → array whose first axis is the batch."""


@dataclass(frozen=True, slots=True)
class Actions:
    """What a policy answers to a batch of k observations.

    actions: (k, *action shape) in the agent's own action space.
    state: recurrent state to hand in at the next call, `state_out_<i>` under the name `state_in_<i>`; None without one.
    dist_inputs: (k, d) float32 inputs of the action distribution, masked; None for scripts or when not asked for.
    """

    actions: NDArray
    state: dict[str, NDArray] | None = None
    dist_inputs: NDArray | None = None


class Policy(Protocol):
    """Anything that acts: an ONNX graph, a script, a client of a policy server."""

    def act(
        self,
        observations: Arrays,
        *,
        state: Arrays | None = None,
        explore: bool = False,
        rng: Sequence[np.random.Generator] | None = None,
    ) -> Actions:
        """Act on a batch.

        observations: `observation` or `observation.<key>`, and `action_mask` where the space has one; (k, …) each.
        explore: sample from the action distribution instead of taking its mode.
        rng: one generator per row. Row i draws from rng[i] alone, so that an answer does not depend on the batch
            it was computed in. Required by scripts and by `explore`.
        """
        ...
