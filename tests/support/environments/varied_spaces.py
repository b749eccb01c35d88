"""Environments with the spaces that Gymnasium allows, usual or not."""

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from tests.support.environments.training_environments import Guessing

PAIR, THREE = spaces.Box(-1, 1, (2,), np.float32), spaces.Discrete(3)
OBSERVATIONS: dict[str, gymnasium.Space[Any]] = {
    "numbers from 5": spaces.Discrete(4, start=5),
    "several numbers": spaces.MultiDiscrete([2, 3], start=[1, -1]),
    "bits": spaces.MultiBinary(4),
    "truths": spaces.Box(0, 1, (5,), np.bool_),
    "scalar": spaces.Dict({"position": PAIR, "speed": spaces.Box(-1, 1, (), np.float32)}),
    "key with a dot": spaces.Dict({"a.b": PAIR, "a": spaces.Dict({"b": PAIR})}),
    "odd keys": spaces.Dict({"wall dist/m": PAIR, "höhe": PAIR, "x:0": THREE}),
    "keys are numbers": spaces.Dict({0: THREE, 1: PAIR}),
    "tuple": spaces.Tuple((THREE, PAIR)),
    "sequence": spaces.Sequence(THREE),
    "text": spaces.Text(5),
    "nothing": spaces.Box(-1, 1, (0,), np.float32),
    "large integers": spaces.Box(0, 2**62, (2,), np.int64),
    "large floats": spaces.Box(-1e300, 1e300, (2,), np.float64),
    "unbounded": spaces.Box(-np.inf, np.inf, (2,), np.float32),
    "channels first": spaces.Box(0, 255, (4, 36, 36), np.uint8),
    "channels last": spaces.Box(0, 255, (36, 36, 4), np.uint8),
    "board": spaces.Box(0, 1, (6, 7, 2), np.float32),
}
ACTIONS: dict[str, gymnasium.Space[Any]] = {
    "from 1": spaces.Discrete(3, start=1),
    "from -1": spaces.Discrete(3, start=-1),
    "only one": spaces.Discrete(1),
    "50,000": spaces.Discrete(50_000),
    "several": spaces.MultiDiscrete([2, 3], start=[1, -1]),
    "table": spaces.MultiDiscrete([[2, 3], [4, 2]]),
    "binary": spaces.MultiBinary(3),
    "scalar": spaces.Box(-1, 1, (), np.float32),
    "unbounded": spaces.Box(-np.inf, np.inf, (2,), np.float32),
    "half bounded": spaces.Box(0, np.inf, (2,), np.float32),
    "equal bounds": spaces.Box(np.array([0, 1], np.float32), np.array([0, 2], np.float32)),
    "integers": spaces.Box(0, 5, (2,), np.int32),
    "tuple": spaces.Tuple((THREE, PAIR)),
}
REFUSED = frozenset(("key with a dot", "keys are numbers", "tuple", "sequence", "text", "nothing"))
REFUSED |= {"large integers", "large floats", "binary", "integers"}
"""Spaces of which `check-env` finds faults."""


def varied(observation: str | None = None, action: str | None = None) -> Guessing:
    """Two opponents who observe samples of a space, and one of whom always wins."""
    return Guessing(
        PAIR if observation is None else OBSERVATIONS[observation],
        THREE if action is None else ACTIONS[action],
        lambda *_: 1.0,
        agents=2,
        opposed=True,
    )
