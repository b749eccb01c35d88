"""Base class of vectorised environments: many copies of an environment, stepped by array operations.

A vectorised environment is a faster implementation of a PettingZoo environment, its *stock environment*. With the same
seeds and actions both report the same, bit for bit.
"""

from abc import ABC, abstractmethod
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class AgentRows:
    """Reports of k agents with the same observation space: what PettingZoo's `last()` returns, in columns.

    Rows are sorted by environment. An agent must act next if its row has neither flag. The arrays belong to the caller:
    an environment must not change them later.

    Attributes:
        envs: Environment of each row, (k,) int64.
        agents: Index of the agent in `possible_agents`, (k,) int64.
        observations: ONNX input name → (k, …), in the dtypes of the observation space: `observation`, and `action_mask`
            if the environment has masks.
        rewards: Sum of the agent's rewards since its previous row, (k,) float64; 0 after a reset.
        terminations: (k,) bool.
        truncations: (k,) bool.
    """

    envs: NDArray[np.int64]
    agents: NDArray[np.int64]
    observations: Mapping[str, NDArray[Any]]
    rewards: NDArray[np.float64]
    terminations: NDArray[np.bool_]
    truncations: NDArray[np.bool_]

    @property
    def has_ended(self) -> NDArray[np.bool_]:
        """Whether each row is the last one of its agent, (k,)."""
        return self.terminations | self.truncations

    @staticmethod
    def of_spaces(blocks: Iterable["AgentRows"], first_alike: Sequence[int]) -> list["AgentRows"]:
        """Return one block for each observation space.

        blocks: none of them empty. first_alike: the first agent with the same observation space, of each agent.
        """
        alike: dict[int, list[AgentRows]] = defaultdict(list)
        for block in blocks:
            alike[first_alike[block.agents[0]]].append(block)
        return [rows[0] if len(rows) == 1 else AgentRows.joined(rows) for _, rows in sorted(alike.items())]

    @staticmethod
    def joined(blocks: Sequence["AgentRows"]) -> "AgentRows":
        """Return the rows of blocks with the same observation space, sorted by environment, then by agent."""
        observations = {
            name: np.concatenate([block.observations[name] for block in blocks]) for name in blocks[0].observations
        }
        columns = [(rows.envs, rows.agents, rows.rewards, rows.terminations, rows.truncations) for rows in blocks]
        envs, agents, *reports = map(np.concatenate, zip(*columns, strict=True))
        return AgentRows(envs, agents, observations, *reports).take(np.lexsort((agents, envs)))

    def take(self, chosen: NDArray[np.int64]) -> "AgentRows":
        """Return some of the rows, in the given order."""
        return AgentRows(
            self.envs.take(chosen),
            self.agents.take(chosen),
            {name: array.take(chosen, axis=0) for name, array in self.observations.items()},
            self.rewards.take(chosen),
            self.terminations.take(chosen),
            self.truncations.take(chosen),
        )


class UnsupportedArguments(Exception):
    """A vectorised environment does not implement these constructor arguments; the stock environment must be used."""


class VectorEnv(ABC):
    """`num_envs` copies of an environment.

    A copy does not restart on its own: when none of its agents must act, its episode is over, and the caller resets it
    with the next seed. Reports of a copy depend on its own seed and actions only, not on the other copies of a call.

    The constructor takes `num_envs` and the arguments of the stock environment. It raises UnsupportedArguments for
    those that it does not implement.
    """

    possible_agents: tuple[str, ...]
    num_envs: int

    @abstractmethod
    def reset(self, env_ids: NDArray[np.int64], seeds: NDArray[np.int64]) -> Sequence[AgentRows]:
        """Start an episode in each of the copies `env_ids`.

        Args:
            env_ids: Copies, (m,), ascending. Those in the middle of an episode abandon it.
            seeds: Seeds of the episodes, (m,), from 0 to 2³¹ - 1.

        Returns:
            The first rows of these copies, in one AgentRows for each observation space, in the order of the agents.
        """

    @abstractmethod
    def step(self, env_ids: NDArray[np.int64], actions: NDArray[Any]) -> Sequence[AgentRows]:
        """Step the copies `env_ids`.

        Args:
            env_ids: Copies, (m,), ascending.
            actions: One row for each agent that must act in these copies, (k,) or (k, …), sorted by copy, then by
                agent. The caller has validated them against action spaces and masks.

        Returns:
            The next rows of these copies, including the last rows of agents that have left. Within a copy, rows are in
            the order in which the stock environment reports them. See `reset`.
        """

    def use_fast_seeds(self) -> None:
        """Draw the random numbers of all further episodes by a faster generator than the stock environment's.

        Called once, before the first reset, by training with `training.seeds: fast`; never in matches. An episode is
        still determined by its seed and actions, and has the same distribution as in the stock environment, but it is
        not the stock environment's episode with this seed. Optional: the method of the base class raises.

        Raises:
            NotImplementedError: The environment has no such generator.
        """
        raise NotImplementedError

    def copy(self, source: NDArray[np.int64], target: NDArray[np.int64]) -> None:
        """Replace the episodes of the copies `target` by those of `source`, so that they continue identically.

        The method of the base class copies the rows of all attributes that are arrays whose first axis is `num_envs`.
        An environment that keeps its state in another way overrides it. `copying.check_copying` tests it.

        Args:
            source: Copies in the middle of an episode, (m,).
            target: Copies, (m,), without repetitions and none of `source`.
        """
        for array in vars(self).values():
            if isinstance(array, np.ndarray) and array.shape[:1] == (self.num_envs,):
                array[target] = array.take(source, axis=0)

    def restore(self, env_ids: NDArray[np.int64], observations: Mapping[str, NDArray[Any]]) -> Sequence[AgentRows]:
        """Continue episodes from observations of the agents that must act, in games in which these show everything.

        Optional: the method of the base class raises.

        Args:
            env_ids: Copies, (m,), ascending.
            observations: As in AgentRows, one for each copy. They are not trusted.

        Returns:
            The rows of these copies. See `reset`.

        Raises:
            NotImplementedError: The environment cannot be restored from observations.
            ObservationError: An observation is not a position of the game, or its game is over.
        """
        raise NotImplementedError

    def state(self, env_ids: NDArray[np.int64]) -> NDArray[np.float32] | None:
        """Return the global states of some copies, (m, size) float32; None if the stock environment has none."""
        del env_ids
        return None
