"""What is asked of a policy, as the body of the action route and the messages of a stream have it."""

import random
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from league.client.encoding import Encoding, encoded, rows

Document = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Question:
    """One observation. seed: what the action will be drawn from; None if the best is asked for.

    Whoever explores without a seed is given one here, so that a question may be put twice.
    """

    document: Document
    seed: int | None

    @classmethod
    def about(
        cls,
        observation: Any,
        encoding: Encoding,
        *,
        explore: bool = False,
        seed: int | None = None,
        probabilities: bool = False,
        state: str | None = None,
    ) -> "Question":
        """The arguments are those of `Client.act`. Raises InvalidInput."""
        drawn_from = _seed(seed) if explore else None
        return cls(
            _document({"observation": encoded(observation, encoding)}, drawn_from, probabilities, state), drawn_from
        )


@dataclass(frozen=True, slots=True)
class BatchQuestion:
    """Several observations. seed: one for all, or one for each."""

    document: Document
    seed: int | list[int] | None

    @classmethod
    def about(
        cls,
        observations: Any,
        encoding: Encoding,
        *,
        explore: bool = False,
        seed: int | Sequence[int] | None = None,
        probabilities: bool = False,
        state: Sequence[str | None] | None = None,
    ) -> "BatchQuestion":
        """The arguments are those of `Client.act_batch`. Raises InvalidInput."""
        drawn_from = (list(seed) if isinstance(seed, Sequence) else _seed(seed)) if explore else None
        tokens = None if state is None else list(state)
        document = {"observations": [encoded(row, encoding) for row in rows(observations)]}
        return cls(_document(document, drawn_from, probabilities, tokens), drawn_from)


def _seed(seed: int | None) -> int:
    return random.getrandbits(63) if seed is None else seed


def _document(document: Document, seed: Any, probabilities: bool, state: Any) -> Document:
    """What is as by default is left out."""
    if seed is not None:
        document |= {"explore": True, "seed": seed}
    if probabilities:
        document["probabilities"] = True
    if state is not None:
        document["state"] = state
    return document
