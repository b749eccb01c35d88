"""Bots for tests, which are contestants in tic-tac-toe: `script:tests.support.policies.bots:NAME`."""

import sys
from typing import Any

import numpy as np
from numpy.typing import NDArray

MODULE = "tests.support.policies.bots"
NOT_A_BOT = 3


def first(observation: NDArray, action_mask: NDArray) -> int:
    return int(np.flatnonzero(action_mask)[0])


def sampled(observation: NDArray, action_mask: NDArray, rng: np.random.Generator) -> int:
    return int(rng.choice(np.flatnonzero(action_mask)))


def all_at_once(observation: NDArray, action_mask: NDArray) -> NDArray:
    return action_mask.argmax(axis=1)


all_at_once.batched = True  # type: ignore[attr-defined]


class Alternating:
    """Takes the first and the last legal action in turns."""

    def __init__(self) -> None:
        self.turn = 0

    def act(self, observation: NDArray, action_mask: NDArray) -> int:
        self.turn += 1
        return int(np.flatnonzero(action_mask)[-(self.turn % 2)])


class Failing(Alternating):
    """Raises at the third action of an episode."""

    def act(self, observation: NDArray, action_mask: NDArray) -> int:
        action = super().act(observation, action_mask)
        if self.turn == 3:
            raise RuntimeError("no idea")
        return action


class Leaving(Alternating):
    """Ends the program at the third action of an episode."""

    def act(self, observation: NDArray, action_mask: NDArray) -> int:
        if self.turn == 2:
            sys.exit("bye")
        return super().act(observation, action_mask)


def failing_at_once(observation: NDArray, action_mask: NDArray) -> NDArray:
    return action_mask.reshape(2, 3)


failing_at_once.batched = True  # type: ignore[attr-defined]


def taken(observation: NDArray, action_mask: NDArray) -> int:
    """The first square that is taken, or one beside the board."""
    return int((np.flatnonzero(action_mask == 0)[:1].tolist() or [99])[0])


def text(observation: NDArray) -> Any:
    return "left"


def needs_more(observation: NDArray, depth: int) -> int:
    return depth
