"""Interface of batched environments, which step many environments per call, and validation of actions.

A step returns one batch per group with the observations of all agents that must act, across all environments. Callers
define the groups: policy ids in training, policies of contestants in matches. In a turn-based game the rows of an agent
are its own turns, and rewards are summed since the agent's previous row.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from league.errors import IllegalAction
from league.spaces import ACTION_MASK, Box, Discrete, MultiBinary, MultiDiscrete, Space

Group = Any
"""Any hashable value."""


@dataclass(frozen=True, slots=True)
class EpisodeStart:
    """An episode to play: the seed of the reset, and the group of each agent in the order of `agents`."""

    seed: int
    groups: Sequence[Group]


NextEpisode = Callable[[int], EpisodeStart | None]
"""Index of an environment → its next episode; None leaves the environment idle."""


@dataclass(slots=True)
class Batch:
    """The k agents of a group that must act.

    Attributes:
        envs: Index of the environment of each row.
        agents: Index of the agent of each row.
        observations: ONNX input name → array (k, …) in the environment's dtype.
        rewards: Sum of the rewards since the agent's previous row; 0.0 in its first.
    """

    envs: list[int]
    agents: list[int]
    observations: dict[str, NDArray]
    rewards: list[float]

    def without(self, envs: Collection[int]) -> list[int]:
        """Return the rows of all other environments."""
        return [row for row, env in enumerate(self.envs) if env not in envs]

    def rows(self, rows: Sequence[int]) -> "Batch":
        """Return a batch of some rows."""
        return Batch(
            [self.envs[row] for row in rows],
            [self.agents[row] for row in rows],
            {name: array[rows] for name, array in self.observations.items()},
            [self.rewards[row] for row in rows],
        )


@dataclass(frozen=True, slots=True)
class Ending:
    """The last report of an agent in an episode. Environments may set one or both flags.

    observation: ONNX input name → array without a batch axis, after the last action.
    """

    env: int
    agent: int
    observation: dict[str, NDArray]
    reward: float
    terminated: bool
    truncated: bool


@dataclass(slots=True)
class Turn:
    """Result of a step: agents that left, environments whose episodes ended, and the agents that must act next.

    Endings belong to the previous episodes; batches may contain the first rows of the next ones.
    """

    batches: dict[Group, Batch] = field(default_factory=dict)
    endings: list[Ending] = field(default_factory=list)
    finished: list[int] = field(default_factory=list)
    crashed: list[int] = field(default_factory=list)
    """Environments that raised an exception and were recreated. Their episodes have no endings and are not in
    `finished`; earlier reports of them must be discarded. The next episodes have already started."""
    states: dict[int, NDArray] = field(default_factory=dict)
    """Environment → its current global state, flat float32, if requested and available."""
    last_states: dict[int, NDArray] = field(default_factory=dict)
    """Finished environment → the global state at the end of its episode."""


class BatchedEnvironment(Protocol):
    """n environments in lockstep. After the end of an episode, the next one starts in the same call."""

    @property
    def agents(self) -> tuple[str, ...]:
        """Names of the agents, which rows and groups refer to by index."""

    @property
    def num_envs(self) -> int:
        """Number of environments."""

    def start(self, next_episode: NextEpisode) -> Turn:
        """Reset all environments. `next_episode` is called for each of them, and after each episode."""

    def step(self, actions: Mapping[Group, NDArray]) -> Turn:
        """Step all environments. actions[group][i] belongs to row i of the group's batch in the last Turn.

        A Turn without batches means that all environments are idle. Raises IllegalAction before any environment is
        stepped.
        """

    def abandon(self, envs: Collection[int]) -> None:
        """Abort the episodes of some environments.

        The next `step` expects actions for the other rows only, and starts their next episodes. As after a crash, the
        aborted episodes have no endings and are not in `finished`.
        """

    def assign(self, env: int, groups: Sequence[Group]) -> None:
        """Change the groups of an environment's agents, starting with the next Turn."""

    @property
    def busy(self) -> int | None:
        """The environment that is executing, for use in signal handlers, or that raised in the last call."""

    def seconds(self, env: int) -> float:
        """Return the execution time of an environment in its current episode, including the reset, in seconds."""

    def render(self, env: int) -> NDArray:
        """Render an environment, (height, width, 3) uint8. Raises EnvironmentMismatch if it cannot be rendered."""

    def close(self) -> None:
        """Close the environments."""


ROUNDING = 1e-5
"""Relative tolerance for actions at the bounds of a Box."""


def check_actions(batch: Batch, actions: NDArray, space: Space, agents: Sequence[str]) -> None:
    """Raise IllegalAction unless all actions (k, …) are in `space` and allowed by the masks."""
    rows = len(batch.envs)
    if len(actions) != rows:
        raise IllegalAction(f"{len(actions)} actions for {rows} agents")
    if isinstance(space, Discrete | Box | MultiDiscrete | MultiBinary) and actions.shape[1:] != space.shape:
        expected = list(space.shape)
        raise IllegalAction(
            f"actions of {agents[batch.agents[0]]} have shape {list(actions.shape[1:])}, not {expected}"
        )
    mask = batch.observations.get(ACTION_MASK)
    legal = legal_rows(actions, space, mask)
    if not legal.all():
        row = int(np.argmin(legal))
        raise IllegalAction(
            f"action {actions[row].tolist()} of {agents[batch.agents[row]]} is illegal"
            + ("" if mask is None else f": action_mask is {mask[row].tolist()}")
        )


def legal_rows(actions: NDArray, space: Space, mask: NDArray | None) -> NDArray:
    """Return which of the actions (k, …) are in `space` and allowed by the mask, (k,) bool."""
    match space:
        case Discrete():
            chosen = actions - space.start
            legal = (chosen >= 0) & (chosen < space.n)
            if mask is not None:
                legal &= mask[np.arange(len(mask)), np.where(legal, chosen, 0)] != 0
            return legal
        case MultiDiscrete():
            choices = np.asarray(space.nvec).ravel()
            chosen = (actions - np.asarray(space.start)).reshape(len(actions), -1)
            inside = (chosen >= 0) & (chosen < choices)
            if mask is not None:
                # The mask concatenates the choices of all elements.
                first = np.cumsum(choices) - choices
                inside &= mask[np.arange(len(mask))[:, np.newaxis], first + np.where(inside, chosen, 0)] != 0
            return inside.all(axis=1)
        case Box():
            low, high = _bound(space.low, -np.inf), _bound(space.high, np.inf)
            inside = (actions >= low - ROUNDING * (1 + np.abs(low))) & (actions <= high + ROUNDING * (1 + np.abs(high)))
            return (inside & np.isfinite(actions)).reshape(len(actions), -1).all(axis=1)
        case MultiBinary():
            return ((actions == 0) | (actions == 1)).reshape(len(actions), -1).all(axis=1)
    return np.ones(len(actions), dtype=bool)


def allows_nothing(mask: NDArray, space: Space) -> NDArray:
    """Return which rows of a mask (k, n) allow no action in at least one element, (k,) bool."""
    if not isinstance(space, MultiDiscrete):
        return ~(mask != 0).any(axis=1)
    choices = np.asarray(space.nvec).ravel()
    return (np.add.reduceat(mask != 0, np.cumsum(choices) - choices, axis=1, dtype=int) == 0).any(axis=1)


def _bound(bound: Any, infinite: float) -> NDArray:
    values = np.array(bound, dtype=np.float64)
    return np.where(np.isnan(values), infinite, values)
