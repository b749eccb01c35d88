"""Interface of a policy: a batched, stateless function from observations to actions."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Arrays = Mapping[str, NDArray]
"""Name of an ONNX input or output → array whose first axis is the batch."""
MAX_BATCH = 1024
"""Observations in one request to a server, by default."""


class MalformedAction(Exception):
    """A policy returned something that is not an action of the space's shape and type."""


@dataclass(frozen=True, slots=True)
class Actions:
    """Result of a policy for a batch of k observations.

    Attributes:
        actions: Actions in the agent's action space, (k, *action shape).
        state: Recurrent state for the next call, under the names `state_in_<i>`; None for policies without state.
        dist_inputs: Masked inputs of the action distribution, (k, d); None for scripts or if not requested.
        faults: Row → the exception that a policy raised for this row only. The row's action is undefined.
    """

    actions: NDArray
    state: dict[str, NDArray] | None = None
    dist_inputs: NDArray | None = None
    faults: Mapping[int, Exception] = field(default_factory=dict)


class Policy(Protocol):
    """An ONNX graph, a script, or a remote policy."""

    def act(
        self,
        observations: Arrays,
        *,
        state: Arrays | None = None,
        explore: bool = False,
        rng: Sequence[np.random.Generator] | None = None,
    ) -> Actions:
        """Choose actions for a batch of k observations.

        Args:
            observations: Arrays (k, …) named `observation` or `observation.<key>`, and `action_mask` if the space has
                one.
            state: Recurrent state of the previous call; None at the start of episodes.
            explore: Sample from the action distribution instead of taking its mode.
            rng: One generator per row, required by scripts and by `explore`. Row i uses only rng[i], so the result does
                not depend on the composition of the batch.

        Returns:
            The actions, and the state for the next call.
        """
