"""What a server answers to an observation, or to a batch of them."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

Probabilities = Any
"""Of a Discrete action, (n,) float64 that sum to 1; of a MultiDiscrete one, a list of such arrays; of a Box, `mean` and
`std` in the action's shape."""


@dataclass(frozen=True, slots=True)
class Answer:
    """An action, and where it comes from.

    action: as the environment takes it: an int, or an array (float32 or int64).
    version, sha256: the version that answered, and the digest of its manifest.
    replica: which one answered; over a stream, the one that it is connected to.
    seed: what the action was drawn from, if it was; with it the same version draws the same action again.
    probabilities: of the actions, if they were asked for.
    state: recurrent state as a token, for the observation that follows; None for policies without.
    """

    action: Any
    version: int
    sha256: str
    replica: str
    seed: int | None = None
    probabilities: Probabilities | None = None
    state: str | None = None


@dataclass(frozen=True, slots=True)
class BatchAnswer:
    """Actions of a batch of k observations, one version's; see `Answer`. state, probabilities: one for each."""

    actions: list[Any]
    version: int
    sha256: str
    replica: str
    seed: int | list[int] | None = None
    probabilities: list[Probabilities] | None = None
    state: list[str] | None = None

    def answer(self, row: int) -> Answer:
        """What was answered to one of the observations.

        Drawn from one seed for all, its action comes again only in a batch where it has the same place.
        """
        return Answer(
            self.actions[row],
            self.version,
            self.sha256,
            self.replica,
            self.seed[row] if isinstance(self.seed, list) else self.seed,
            None if self.probabilities is None else self.probabilities[row],
            None if self.state is None else self.state[row],
        )


def answer(document: Mapping[str, Any], replica: str, seed: int | None) -> Answer:
    """Read a reply to one observation."""
    probabilities = document.get("probabilities")
    return Answer(
        taken(document["action"]),
        document["version"],
        document["sha256"],
        replica,
        seed,
        None if probabilities is None else _probabilities(probabilities),
        document.get("state"),
    )


def batch_answer(document: Mapping[str, Any], replica: str, seed: int | list[int] | None) -> BatchAnswer:
    """Read a reply to a batch."""
    probabilities = document.get("probabilities")
    return BatchAnswer(
        [taken(action) for action in document["actions"]],
        document["version"],
        document["sha256"],
        replica,
        seed,
        None if probabilities is None else [_probabilities(each) for each in probabilities],
        document.get("state"),
    )


def taken(action: Any) -> Any:
    """An action as an environment takes it: JSON has no arrays, and knows no float32."""
    if isinstance(action, int):
        return action
    array = np.asarray(action)
    return array.astype(np.float32) if array.dtype.kind == "f" else array


def _probabilities(value: Any) -> Probabilities:
    if isinstance(value, dict):
        return {name: np.asarray(part) for name, part in value.items()}
    if value and isinstance(value[0], list):
        return [np.asarray(each) for each in value]
    return np.asarray(value)
