"""Bots: contestants that are functions or classes of the user's code, `script:my_package.module:name`.

A bot runs wherever games are played: in evaluations, training, replays and human play. Serving replicas never import
it. docs/bots.md describes the interface for authors.
"""

import inspect
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from league.entry_points import import_entry_point
from league.errors import ConfigError, EnvironmentMismatch, no_exit
from league.policies.draws import Generators
from league.policies.policy import Actions, Arrays, MalformedAction
from league.spaces import ACTION_MASK, OBSERVATION, DictSpace, Leaf, Space, beside_mask
from league.spaces.arrays import nested

INSTANCE = "instance"
"""The state of a bot that is a class: its instances, (k,) of objects; 0 before an agent's first action."""
OPTIONAL = (ACTION_MASK, "rng")
"""Arguments that a bot gets if it names them."""


class Bot:
    """A bot as a policy.

    Args:
        entry_point: `module:name` of a function or a class with a method `act`.
        observation: Observation space of the agent.
        action: Action space of the agent.

    Raises:
        ConfigError: The bot cannot be imported, or does not have the interface of a bot.
        EnvironmentMismatch: Bots do not support the action space.
    """

    def __init__(self, entry_point: str, observation: Space, action: Space) -> None:
        self._name = f"script:{entry_point}"
        if isinstance(action, DictSpace):
            raise EnvironmentMismatch(f"{self._name} cannot play: bots do not support dict actions")
        # A bot gets what is observed beside the mask, which has the same names.
        self._observed, self._action = beside_mask(observation)[1], action
        self._bot = import_entry_point(self._name, entry_point)
        is_class = inspect.isclass(self._bot)
        if not callable(getattr(self._bot, "act", None) if is_class else self._bot):
            expected = "expected a function, or a class with a method `act`"
            raise ConfigError(f"{self._name} is a {type(self._bot).__name__}: {expected}")
        self._batched = bool(getattr(self._bot, "batched", False))
        if self._batched and is_class:
            raise ConfigError(f"{self._name} is a class and has `batched`: expected a function")
        self._remembers = is_class
        self._arguments = _arguments(self._name, self._bot.act if is_class else self._bot, is_class)

    def initial_state(self, batch: int) -> dict[str, NDArray]:
        """Return the state at the start of `batch` episodes; empty for functions."""
        return {INSTANCE: np.zeros(batch, dtype=object)} if self._remembers else {}

    def act(
        self,
        observations: Arrays,
        *,
        state: Arrays | None = None,
        explore: bool = False,  # noqa: ARG002
        rng: Generators | None = None,
    ) -> Actions:
        """Choose actions for a batch; see `Policy.act`. If the bot raises for a row, the row has a fault."""
        if self._batched:
            with no_exit:
                output = self._bot(self._observation(observations), **self._optional(observations, rng))
            return Actions(np.asarray(output))
        rows = len(next(iter(observations.values())))
        state = (state or self.initial_state(rows)) if self._remembers else None
        after = None if state is None else {INSTANCE: state[INSTANCE].copy()}
        actions = np.zeros((rows, *self._action.shape), self._action.dtype)
        faults: dict[int, Exception] = {}
        for row in range(rows):
            row_observations = {name: array[row] for name, array in observations.items()}
            try:
                with no_exit:
                    if after is not None and isinstance(after[INSTANCE][row], int):
                        after[INSTANCE][row] = self._bot()  # at the first action in an episode
                    act = self._bot if after is None else after[INSTANCE][row].act
                    action = act(
                        self._observation(row_observations),
                        **self._optional(row_observations, None if rng is None else rng[row]),
                    )
                actions[row] = _action(action, self._action)
            except MemoryError:
                raise
            except Exception as error:
                faults[row] = error
        return Actions(actions, after, faults=faults)

    def _optional(self, observations: Mapping[str, Any], rng: Any) -> dict[str, Any]:
        arguments = {ACTION_MASK: observations.get(ACTION_MASK), "rng": rng}
        return {name: arguments[name] for name in self._arguments}

    def _observation(self, arrays: Mapping[str, Any]) -> Any:
        """The observation without its action mask, as the environment returns it."""
        return nested(self._observed, arrays)


def _arguments(name: str, act: Callable[..., Any], is_method: bool) -> tuple[str, ...]:
    """The optional arguments that a bot names. Raises ConfigError if others are required."""
    parameters = list(inspect.signature(act).parameters.values())[int(is_method) :]
    accepts_all = any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters)
    named = {parameter.name for parameter in parameters[1:]}
    required = [
        parameter.name
        for parameter in parameters[1:]
        if parameter.default is parameter.empty
        and parameter.name not in OPTIONAL
        and parameter.kind not in (parameter.VAR_KEYWORD, parameter.VAR_POSITIONAL)
    ]
    if required or not parameters:
        problem = f"requires {required[0]!r}" if required else "takes no observation"
        raise ConfigError(f"{name} {problem}: expected the arguments {OBSERVATION}, {ACTION_MASK} and rng")
    return tuple(argument for argument in OPTIONAL if accepts_all or argument in named)


def _action(chosen: Any, space: Leaf) -> NDArray:
    """One action in the dtype of the space. Raises MalformedAction if its shape or type differs."""
    array = np.asarray(chosen)
    kinds = "iuf" if np.dtype(space.dtype).kind == "f" else "iu"
    if array.shape == space.shape and array.dtype.kind in kinds:
        action = array.astype(space.dtype)
        if kinds == "iuf" or np.array_equal(action, array):
            return action
    expected = f"expected {space.dtype} {list(space.shape)}"
    raise MalformedAction(f"the bot returned {type(chosen).__name__} {str(chosen)[:80]!r}: {expected}")
