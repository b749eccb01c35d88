"""The batched stepping protocol: n copies of an environment are reset and stepped by one call.

A call yields, per group, one batch of the observations of all agents that must act, in all copies. What a group is,
is the caller's: a policy id in training, a contestant's policy in a match. In a turn-based game an agent's rows are its
own turns: the reward of a row is summed over all moves since the agent's previous row.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

from numpy.typing import NDArray

Group = Any
"""Anything hashable."""


@dataclass(frozen=True, slots=True)
class Episode:
    """What a copy plays next: the seed of its reset, and the group of each agent in the order of `agents`."""

    seed: int
    groups: Sequence[Group]


NextEpisode = Callable[[int], Episode | None]
"""copy → its next episode, or None: the copy stays idle."""


@dataclass(slots=True)
class Batch:
    """The k agents of one group that must act now. Row i is agent agents[i] (an index) of copy copies[i].

    observations: ONNX input name → (k, …) in the environment's dtype.
    rewards: summed since the agent's previous row; 0.0 at its first.
    """

    copies: list[int]
    agents: list[int]
    observations: dict[str, NDArray]
    rewards: list[float]

    def without(self, copies: Collection[int]) -> list[int]:
        """The rows that are not of these copies."""
        return [row for row, copy in enumerate(self.copies) if copy not in copies]

    def rows(self, rows: Sequence[int]) -> "Batch":
        """A batch of these rows."""
        return Batch(
            [self.copies[row] for row in rows],
            [self.agents[row] for row in rows],
            {name: array[rows] for name, array in self.observations.items()},
            [self.rewards[row] for row in rows],
        )


@dataclass(frozen=True, slots=True)
class Ending:
    """The last report of an agent that has left its episode. Exactly one of the two flags may be the reason;
    an environment that sets both at once is reported as it is.

    observation: ONNX input name → array without a batch axis: the state after the last move.
    """

    copy: int
    agent: int
    observation: dict[str, NDArray]
    reward: float
    terminated: bool
    truncated: bool


@dataclass(slots=True)
class Turn:
    """What a call brought: agents that left, copies whose episode is over, and who must act next.

    Endings belong to the episodes before; batches may already hold the first rows of a copy's next episode.
    """

    batches: dict[Group, Batch] = field(default_factory=dict)
    endings: list[Ending] = field(default_factory=list)
    finished: list[int] = field(default_factory=list)
    crashed: list[int] = field(default_factory=list)
    """Copies whose environment raised and was built anew. Their episode has no endings and is not in `finished`: what
    was reported of it is to be dropped. Their next one has begun in this call."""
    states: dict[int, NDArray] = field(default_factory=dict)
    """Copy → the global state as it stands, float32 and flat, where it is asked for and the environment has one."""
    last_states: dict[int, NDArray] = field(default_factory=dict)
    """Of the finished copies, the state that their episode ended in."""


class BatchedEnvironment(Protocol):
    """n copies in lockstep. A copy whose episode is over restarts with its next one in the same call."""

    @property
    def agents(self) -> tuple[str, ...]:
        """Agent names; rows and groups refer to them by index."""
        ...

    @property
    def copies(self) -> int:
        """n"""
        ...

    def start(self, next_episode: NextEpisode) -> Turn:
        """Reset every copy. `next_episode` is called here and at each restart."""
        ...

    def step(self, actions: Mapping[Group, NDArray]) -> Turn:
        """Act: actions[group][i] is row i of the last Turn's batch of that group. A Turn without batches means that
        all copies are idle. Raises IllegalAction, naming agent and action, before any copy has moved."""
        ...

    def abandon(self, copies: Collection[int]) -> None:
        """Break the episodes of these copies off. Their rows leave the last Turn: the next `step` takes actions of the
        others only, and restarts these in the same call. As of a crash, no endings of theirs are reported, nor are they
        in `finished`."""
        ...

    def assign(self, copy: int, groups: Sequence[Group]) -> None:
        """Change the groups of a copy's agents from the next Turn on."""
        ...

    @property
    def busy(self) -> int | None:
        """The copy whose environment is at work at this moment, for who looks from a signal handler; or whose
        environment raised what came out of the last call."""
        ...

    def seconds(self, copy: int) -> float:
        """How long a copy's environment has worked on its episode, reset included and also if it is at it just now."""
        ...

    def render(self, copy: int) -> NDArray:
        """A picture of the copy as it stands, (height, width, 3) uint8. Raises EnvironmentMismatch if it has none."""
        ...

    def close(self) -> None:
        """Release the copies."""
        ...
