"""Scripted baselines, which need no training.

`random` samples uniformly from the legal actions; `first` takes the first one. `mirror` repeats its observation, which
is the opponent's last move in rock, paper, scissors. `one_ply`, `minimax_2`, `minimax_4`, `mcts_100`, `mcts_1000` and
`solver` play connect four and tic-tac-toe; see `league.policies.line_games`.
"""

from collections.abc import Callable
from functools import partial
from typing import assert_never

import numpy as np
from numpy.typing import NDArray

from league.errors import EnvironmentMismatch, UnknownPolicy
from league.policies.actions import to_environment
from league.policies.bots import Bot
from league.policies.draws import Generators, UniformNumbers, choose, draw, elements
from league.policies.line_games.mcts import MCTS
from league.policies.line_games.minimax import Minimax, OnePly
from league.policies.line_games.solver import Solver
from league.policies.policy import Actions, Arrays, Policy
from league.spaces import (
    ACTION_MASK,
    OBSERVATION,
    Box,
    DictSpace,
    Discrete,
    Leaf,
    MultiBinary,
    MultiDiscrete,
    Space,
    inputs,
)
from league.spaces.arrays import bounds, check_legal_action, mask_size


def script(name: str, observation: Space, action: Space) -> Policy:
    """Create a scripted policy.

    Args:
        name: Name of a script, or the entry point of a bot, `my_package.module:name`.
        observation: Observation space of the agent.
        action: Action space of the agent.

    Raises:
        UnknownPolicy: The script does not exist.
        EnvironmentMismatch: The script does not support the spaces.
        ConfigError: The bot cannot be imported, or does not have the interface of a bot.
    """
    if ":" in name:
        return Bot(name, observation, action)
    if name not in SCRIPTS:
        raise UnknownPolicy(
            f"unknown script {name!r}; known: {', '.join(SCRIPTS)}, or a bot, script:my_package.module:name"
        )
    return SCRIPTS[name](observation, action)


class Random:
    """Samples uniformly from the legal actions, or from the action space if there is no mask."""

    def __init__(self, observation: Space, action: Space) -> None:
        self._action = _playable("random", observation, action)
        self._masked = ACTION_MASK in inputs(observation)
        if isinstance(action, Box) and not all(np.isfinite(bound).all() for bound in bounds(action)):
            raise EnvironmentMismatch(f"script:random does not support unbounded actions: {action!r}")

    @property
    def numbers_per_action(self) -> int:
        """How many random numbers an action takes."""
        return int(np.prod(self._action.shape, dtype=int))

    def act(
        self,
        observations: Arrays,
        *,
        state: Arrays | None = None,  # noqa: ARG002
        explore: bool = False,  # noqa: ARG002
        rng: Generators | UniformNumbers | None = None,
    ) -> Actions:
        """Choose actions for a batch; see `Policy.act`. Raises IllegalMask if a row allows no action."""
        if self._masked:
            masks = _masks(observations[ACTION_MASK], self._action)
            uniform = draw(rng, len(masks[0]), (len(masks),) if self._action.shape else ()).reshape(-1, len(masks))
            choices = [choose(mask, uniform[:, i]) for i, mask in enumerate(masks)]
            return Actions(_raw_to_environment(choices, self._action))
        rows = len(next(iter(observations.values())))
        return Actions(_spread(draw(rng, rows, self._action.shape), self._action))


class First:
    """Takes the first legal action: the smallest integer, the lower bound, or without one the value closest to 0."""

    def __init__(self, observation: Space, action: Space) -> None:
        self._action = _playable("first", observation, action)
        self._masked = ACTION_MASK in inputs(observation)

    def act(
        self,
        observations: Arrays,
        *,
        state: Arrays | None = None,  # noqa: ARG002
        explore: bool = False,  # noqa: ARG002
        rng: Generators | None = None,  # noqa: ARG002
    ) -> Actions:
        """Choose actions for a batch; see `Policy.act`. Raises IllegalMask if a row allows no action."""
        if self._masked:
            masks = _masks(observations[ACTION_MASK], self._action)
            return Actions(_raw_to_environment([(mask != 0).argmax(axis=1) for mask in masks], self._action))
        rows = len(next(iter(observations.values())))
        return Actions(np.repeat(_lowest(self._action)[np.newaxis], rows, axis=0))


class Mirror:
    """Repeats its observation: one of n actions, or n if there is none yet, for which it takes the first action.

    In PettingZoo's rock, paper, scissors the observation is the opponent's last move.
    """

    def __init__(self, observation: Space, action: Space) -> None:
        if not (isinstance(observation, Discrete) and isinstance(action, Discrete) and observation.n == action.n + 1):
            raise EnvironmentMismatch("script:mirror requires observations Discrete(n + 1) for actions Discrete(n)")
        self._observation, self._action = observation, action

    def act(
        self,
        observations: Arrays,
        *,
        state: Arrays | None = None,  # noqa: ARG002
        explore: bool = False,  # noqa: ARG002
        rng: Generators | None = None,  # noqa: ARG002
    ) -> Actions:
        """Choose actions for a batch; see `Policy.act`."""
        opponent_moves = observations[OBSERVATION] - self._observation.start
        return Actions(to_environment(np.where(opponent_moves < self._action.n, opponent_moves, 0), self._action))


SCRIPTS: dict[str, Callable[[Space, Space], Policy]] = {
    "random": Random,
    "one_ply": OnePly,
    "first": First,
    "mirror": Mirror,
    "minimax_2": partial(Minimax, 2),
    "minimax_4": partial(Minimax, 4),
    "mcts_100": partial(MCTS, 100),
    "mcts_1000": partial(MCTS, 1000),
    "solver": Solver,
}


def _playable(name: str, observation: Space, action: Space) -> Leaf:
    """Return the action space if the script supports it and its mask, if there is one."""
    if isinstance(action, DictSpace):
        raise EnvironmentMismatch(f"script:{name} does not support {action.type} actions")
    mask = inputs(observation).get(ACTION_MASK)
    if mask is not None and mask.shape != (mask_size(action),):
        raise EnvironmentMismatch(
            f"script:{name} does not support a mask of shape {list(mask.shape)} for actions {action!r}"
        )
    return action


def _masks(mask: NDArray, action: Leaf) -> list[NDArray]:
    """The mask (k, n) of each element of the action. Raises IllegalMask if one allows no action."""
    masks = elements(mask, action) if isinstance(action, MultiDiscrete) else [mask]
    for part in masks:
        check_legal_action(part)
    return masks


def _raw_to_environment(chosen: list[NDArray], action: Leaf) -> NDArray:
    raw = np.stack(chosen, axis=1) if isinstance(action, MultiDiscrete) else chosen[0]
    return to_environment(raw, action)


def _lowest(action: Leaf) -> NDArray:
    match action:
        case Discrete(start=start) | MultiDiscrete(start=start):
            lowest = np.asarray(start)
        case MultiBinary(shape=shape):
            lowest = np.zeros(shape)
        case Box():
            low, high = bounds(action)
            lowest = np.where(np.isfinite(low), low, np.minimum(high, 0))
        case _:
            assert_never(action)
    return lowest.astype(action.dtype)


def _spread(uniform: NDArray, space: Leaf) -> NDArray:
    """Map uniform numbers in [0, 1) to a space, (k, *shape) in its dtype."""
    match space:
        case Discrete():
            values = space.start + np.floor(uniform * space.n)
        case MultiDiscrete():
            values = np.asarray(space.start) + np.floor(uniform * np.asarray(space.nvec))
        case MultiBinary():
            values = np.floor(uniform * 2)
        case Box():
            low, high = bounds(space)
            values = low + uniform * (high - low)
            if np.dtype(space.dtype).kind != "f":
                values = np.floor(low + uniform * (high - low + 1))
        case _:
            assert_never(space)
    return values.astype(space.dtype)
