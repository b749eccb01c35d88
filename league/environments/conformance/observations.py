"""Checks of observations against their spaces."""

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from league.environments.adapters import Observation
from league.environments.building import agent_interface
from league.environments.conformance.findings import Examination
from league.environments.conformance.recordings import Recording, joined
from league.errors import EnvironmentMismatch, InvalidReturn
from league.spaces import ACTION_MASK, Box, Leaf, inputs
from league.spaces.arrays import bounds, tensors

ENOUGH_TURNS = 20
"""Minimum turns of an agent for the check that its observations change."""


REMEDY = "correct observation_space, or what reset and step return"

LARGEST = 1e9
"""Absolute value above which gradients overflow, in networks that take it as it is."""


class ObservationCheck:
    """Splits an agent's observations into arrays, and checks them against its space."""

    def __init__(self, agent: str, env: Any, examination: Examination, normalizes: bool) -> None:
        """normalizes: whether training scales floats by their running statistics."""
        self._agent, self._examination = agent, examination
        self._gymnasium = env.observation_space(agent)
        self._space = agent_interface(env, agent).observation
        self._leaves = inputs(self._space)
        self._raw = {
            name: leaf
            for name, leaf in self._leaves.items()
            if isinstance(leaf, Box) and not (normalizes and np.dtype(leaf.dtype).kind == "f")
        }
        self._kept: list[tuple[NDArray, NDArray]] = []

    def __call__(self, value: Any) -> Observation:
        for array, copy in self._kept:
            if not np.array_equal(array, copy, equal_nan=True):
                text = "its observations are modified after they are returned: they are copied"
                self._examination.add("note", text, self._agent)
        arrays = self.arrays(value)
        misshapen = [name for name, leaf in self._leaves.items() if arrays[name].shape != leaf.shape]
        for name in misshapen:
            shape, expected = list(arrays[name].shape), list(self._leaves[name].shape)
            text = f"observes {name} with shape {shape}, but its space has {expected}: {REMEDY}"
            if name == ACTION_MASK:
                raise InvalidReturn(f"agent {self._agent} {text}")  # no legal action can be drawn
            self._examination.add("fault", text, self._agent)
        for name, leaf in self._raw.items() if not misshapen else ():
            largest = np.abs(arrays[name].astype(np.float64)).max()
            if LARGEST < largest < np.inf:
                text = f"observes too large values in {name}: training needs at most {LARGEST:g}: scale them"
                remedy = ", or set training.normalize_observations" * (np.dtype(leaf.dtype).kind == "f")
                self._examination.add("fault", text + remedy, self._agent, example=f"{largest:.3g}")
        if not misshapen and not self._gymnasium.contains(value):
            self._examination.add(
                "note",
                f"observations are not in its space {_shortened(self._gymnasium)}: the bounds or the dtype differ;"
                " values are cast to the dtype of the space",
                self._agent,
                example=_example_outside(self._leaves, arrays),
            )
        copies = {name: np.array(array) for name, array in arrays.items()}
        self._kept = [(array, copies[name]) for name, array in arrays.items()]
        return copies

    def arrays(self, value: Any) -> Observation:
        """Split an observation. Raises EnvironmentMismatch if its structure is not that of the space."""
        try:
            return tensors(self._space, value)
        except (TypeError, ValueError, LookupError) as error:
            kind = f"a dict with {', '.join(map(str, value))}" if isinstance(value, Mapping) else type(value).__name__
            raise EnvironmentMismatch(
                f"{self._agent} observes {kind}, but its space is {_shortened(self._gymnasium)}: {REMEDY}"
            ) from error


def _shortened(space: gymnasium.Space[Any]) -> str:
    text = str(space)
    return text if len(text) <= 80 else f"{text[:79]}…"


def _example_outside(leaves: Mapping[str, Leaf], arrays: Observation) -> str:
    """Describe the first value outside of its bounds; empty if only the dtype or the structure differs."""
    for name, leaf in leaves.items():
        if not isinstance(leaf, Box) or np.shape(arrays[name]) != leaf.shape:
            continue
        low, high = bounds(leaf)
        array = np.asarray(arrays[name], np.float64)
        for index in map(tuple, np.argwhere((array < low) | (array > high))[:1].tolist()):
            place = f"{name}[{', '.join(map(str, index))}]"
            return f"{place} is {array[index]:g}, outside of [{low[index]:g}, {high[index]:g}]"
    return ""


def check_constant_observations(episodes: Sequence[Recording], env: Any, examination: Examination) -> None:
    """Find agents whose observation never changes in the second half of an episode, when frame stacks are full.

    A constant image is a fault; a constant vector is a note, because a game may have a single state.
    """
    for index, agent in enumerate(env.possible_agents):
        histories = [
            [joined(observation) for reporting, observation, *_ in episode.reports if reporting == index]
            for episode in episodes
        ]
        turns = max(map(len, histories))
        if turns < ENOUGH_TURNS or any(len(set(history[len(history) // 2 :])) > 1 for history in histories):
            continue
        space = env.observation_space(agent)
        if isinstance(space, gymnasium.spaces.Box) and len(space.shape) > 1:
            text = (
                f"observes a constant image for {turns} turns; some environments draw only with"
                " `kwargs: {render_mode: rgb_array}`"
            )
            examination.add("fault", text, agent)
        else:
            examination.add("note", f"observes a constant value in an episode of {turns} turns", agent)
