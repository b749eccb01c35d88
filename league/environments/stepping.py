"""Interface of batched environments, which step many environments per call; validation of actions.

A step returns one batch per group with the observations of all agents that must act, across all environments. Groups
are numbers that callers define: policies in training, policies of contestants in matches. In a turn-based game the rows
of an agent are its own turns, and rewards are summed since the agent's previous row.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from league.environments.vector.vector_env import AgentRows
from league.errors import IllegalAction
from league.spaces import ACTION_MASK, Box, DictSpace, Discrete, MultiBinary, MultiDiscrete, Space
from league.spaces.arrays import bounds

Indices = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Starts:
    """Episodes to start.

    Attributes:
        envs: Environments, (m,), ascending.
        seeds: Seeds of the resets, (m,) int64.
        groups: Group of each agent, (m, agents).
    """

    envs: Indices
    seeds: Indices
    groups: Indices


NextEpisodes = Callable[[Indices], Starts]
"""Environments without an episode, ascending → the episodes that start in some of them; the others stay idle."""


def each_agent_alone(seeds: Iterable[int], agents: int) -> NextEpisodes:
    """Return the episodes with these seeds, in order, for whichever environments are free.

    The group of an agent is its index.
    """
    coming = iter(seeds)

    def next_episodes(envs: Indices) -> Starts:
        next_seeds = np.fromiter(islice(coming, len(envs)), np.int64)
        return Starts(envs[: len(next_seeds)], next_seeds, np.tile(np.arange(agents), (len(next_seeds), 1)))

    return next_episodes


@dataclass(frozen=True, slots=True)
class Batch:
    """The k agents of a group that must act, sorted by environment.

    Attributes:
        envs: Index of the environment of each row, (k,).
        agents: Index of the agent of each row, (k,).
        observations: ONNX input name → array (k, …) in the environment's dtype.
        rewards: Sum of the rewards since the agent's previous row, (k,); 0 in its first.
    """

    envs: Indices
    agents: Indices
    observations: dict[str, NDArray]
    rewards: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.envs)

    def without(self, envs: Indices) -> Indices:
        """Return the rows of all other environments."""
        return np.flatnonzero(~np.isin(self.envs, envs))

    def rows(self, rows: NDArray) -> "Batch":
        """Return a batch of some rows."""
        return Batch(
            self.envs.take(rows),
            self.agents.take(rows),
            {name: array.take(rows, axis=0) for name, array in self.observations.items()},
            self.rewards.take(rows),
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


@dataclass(frozen=True, slots=True)
class States:
    """Global states, flat: values[i] is that of environment envs[i]; (m,) and (m, size) float32."""

    envs: Indices
    values: NDArray[np.float32]


def no_envs() -> Indices:
    """Return an empty list of environments."""
    return np.zeros(0, np.int64)


@dataclass(slots=True)
class Turn:
    """Result of a step: agents that left, environments whose episodes ended, and the agents that must act next.

    Endings belong to the previous episodes; batches may contain the first rows of the next ones. Lists of environments
    are ascending.
    """

    batches: dict[int, Batch] = field(default_factory=dict)
    """Group → its rows, by ascending group."""
    endings: Sequence[AgentRows] = ()
    """The last reports of agents, in one block for each observation space. Each row has one or both flags."""
    finished: Indices = field(default_factory=no_envs)
    crashed: Indices = field(default_factory=no_envs)
    """Environments that raised an exception and were recreated, or lost their simulators. Their episodes have no
    endings and are not in `finished`; earlier reports of them must be discarded. The next episodes have already
    started, or start with the next step if a simulator was lost."""
    states: States | None = None
    """The current global state of each environment with an episode, if requested and available."""
    last_states: States | None = None
    """The global states of finished environments at the end of their episodes."""

    def acting(self, num_envs: int) -> NDArray[np.bool_]:
        """Return which environments have agents that must act, (num_envs,)."""
        acting = np.zeros(num_envs, bool)
        for batch in self.batches.values():
            acting[batch.envs] = True
        return acting

    def each_ending(self) -> Iterator[Ending]:
        """Yield the rows of `endings`, for callers with few environments."""
        for rows in self.endings:
            for i, (env, agent) in enumerate(zip(rows.envs.tolist(), rows.agents.tolist(), strict=True)):
                observation = {name: array[i] for name, array in rows.observations.items()}
                flags = bool(rows.terminations[i]), bool(rows.truncations[i])
                yield Ending(env, agent, observation, float(rows.rewards[i]), *flags)


class BatchedEnvironment(ABC):
    """n environments, stepped together. After the end of an episode, the next one starts in the same call.

    Attributes:
        agents: Names of the agents, which rows and groups refer to by index.
        num_envs: Number of environments.
    """

    def __init__(self, agents: Sequence[str], num_envs: int) -> None:
        self.agents: tuple[str, ...] = tuple(agents)
        self.num_envs = num_envs
        self._groups = np.zeros((num_envs, len(agents)), np.int64)
        self._seeds, self._seconds = np.zeros(num_envs, np.int64), np.zeros(num_envs)
        self._pending: dict[int, Batch] = {}
        self._abandoned = no_envs()
        self._next_episodes: NextEpisodes

    @abstractmethod
    def start(self, next_episodes: NextEpisodes) -> Turn:
        """Reset all environments. `next_episodes` is called for all of them, and in each step after which some have
        no episode."""

    @abstractmethod
    def step(self, actions: Mapping[int, NDArray]) -> Turn:
        """Step the environments of the last Turn. actions[group][i] belongs to row i of the group's batch in it.

        Without simulators these are all environments with an episode. A Turn without batches and crashed environments
        means that all environments are idle. Raises IllegalAction before any environment is
        stepped.
        """

    def abandon(self, envs: Indices) -> None:
        """Abort the episodes of some environments.

        The next `step` expects actions for the other rows only, and starts their next episodes. As after a crash, the
        aborted episodes have no endings and are not in `finished`.
        """
        self._abandoned = np.union1d(self._abandoned, envs)
        kept = {group: batch.rows(batch.without(envs)) for group, batch in self._pending.items()}
        self._pending = {group: batch for group, batch in kept.items() if len(batch)}

    def assign(self, envs: Indices, groups: Indices) -> None:
        """Change the groups, (m, agents), of the agents of m environments, starting with the next Turn."""
        self._groups[envs] = groups

    @property
    @abstractmethod
    def busy(self) -> Indices:
        """The environments that are executing, for use in signal handlers, or the one that raised in the last call.

        Several execute together if a vectorised environment steps them; if it hangs, one of them does.
        """

    @abstractmethod
    def seconds(self) -> NDArray[np.float64]:
        """Return the execution time of each environment in its current episode, including the reset, (n,) in seconds.

        Environments that execute together share the time of a finished call equally. Each counts all of the time of a
        call in progress.
        """

    @abstractmethod
    def render(self, env: int, agent: str | None = None) -> NDArray:
        """Render an environment, (height, width, 3) uint8.

        agent: render what this agent sees, by the environment's `render_for`; by default everything.
        Raises EnvironmentMismatch if it cannot be rendered.
        """

    @abstractmethod
    def close(self) -> None:
        """Close the environments. An environment that hangs is the last one. What they raise is logged."""

    def _starts(self, free: Indices) -> Indices:
        """Return the environments among `free` ones whose next episodes start."""
        starts = self._next_episodes(free)
        self._groups[starts.envs] = starts.groups
        self._seconds[starts.envs] = 0.0
        # Some environments store the seed as a signed 32-bit integer.
        self._seeds[starts.envs] = starts.seeds % 2**31
        return starts.envs

    def _batches(self, alike: Iterable[Sequence[AgentRows]]) -> dict[int, Batch]:
        """Return the rows of agents that must act by ascending group. alike: blocks with the same observations."""
        batches = dict(pair for blocks in alike for pair in self._split(blocks))
        return dict(sorted(batches.items()))

    def _split(self, blocks: Sequence[AgentRows]) -> Iterator[tuple[int, Batch]]:
        """Return the groups of agents with the same observations, and the rows of each."""
        names = blocks[0].observations
        batch = Batch(
            joined([block.envs for block in blocks]),
            joined([block.agents for block in blocks]),
            {name: joined([block.observations[name] for block in blocks]) for name in names},
            joined([block.rewards for block in blocks]),
        )
        groups = self._groups[batch.envs, batch.agents]
        present = np.bincount(groups).nonzero()[0].tolist()
        if len(blocks) == len(present) == 1:
            yield present[0], batch
            return
        by_env = None
        if len(blocks) > 1:
            by_env = np.argsort(batch.envs, kind="stable")
            groups = groups.take(by_env)
        for group in present:
            rows = (groups == group).nonzero()[0]
            yield group, batch.rows(rows if by_env is None else by_env.take(rows))


def joined(columns: Sequence[NDArray]) -> NDArray:
    """Return columns, one below the other."""
    return columns[0] if len(columns) == 1 else np.concatenate(columns)


ROUNDING = 1e-5
"""Relative tolerance for actions at the bounds of a Box."""


def check_actions(batch: Batch, actions: NDArray, space: Space, agents: Sequence[str]) -> None:
    """Raise IllegalAction unless all actions (k, …) are in `space` and allowed by the masks."""
    rows = len(batch)
    if len(actions) != rows:
        raise IllegalAction(f"{len(actions)} actions for {rows} agents")
    if not isinstance(space, DictSpace) and actions.shape[1:] != space.shape:
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
            indices = actions - space.start
            legal = (indices >= 0) & (indices < space.n)
            if mask is not None:
                legal &= mask.take(np.arange(0, mask.size, mask.shape[1]) + indices, mode="clip") != 0
            return legal
        case MultiDiscrete():
            choices = np.asarray(space.nvec).ravel()
            indices = (actions - np.asarray(space.start)).reshape(len(actions), -1)
            inside = (indices >= 0) & (indices < choices)
            if mask is not None:
                # The mask concatenates the choices of all elements.
                first = np.cumsum(choices) - choices
                inside &= mask[np.arange(len(mask))[:, np.newaxis], first + np.where(inside, indices, 0)] != 0
            return inside.all(axis=1)
        case Box():
            low, high = bounds(space)
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
