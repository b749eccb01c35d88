"""What a central critic gets besides an agent's own observation: all agents' observations, or the global state.

Only learners use these columns, whose names begin with CENTRAL:

| `central/<agent>/<input>` | (k, …), the agent's latest observation in the episode, without masks; 0 if it is absent |
| `central/present` | (k, agents) int8: 0 for an agent that has not observed anything yet, or has left |
| `central/state` | (k, s) float32: the environment's `state()` |

Where agents take turns, the latest observation is that of an agent's own last turn.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Protocol

import gymnasium
import numpy as np
from numpy.typing import NDArray

from league.config.environment import EnvironmentConfig
from league.config.ppo import Critic
from league.environments.stepping import Indices, Turn
from league.errors import ConfigError
from league.interface import Interface
from league.spaces import ACTION_MASK, inputs
from league.spaces.conversion import to_gymnasium
from training.sampling.closed_transitions import own_state_size

CENTRAL = "central/"
PRESENT, STATE = f"{CENTRAL}present", f"{CENTRAL}state"


class CentralObserver(Protocol):
    """Follows the episodes of a runner."""

    def extended(self, turn: Turn) -> Turn:
        """Return the turn with central columns among the observations of its batches and endings."""


class JointObservations:
    """The latest observations of all agents."""

    def __init__(self, interface: Interface, agents: Sequence[str], num_envs: int) -> None:
        self._agents = agents
        self._latest = [
            {
                name: np.zeros((num_envs, *leaf.shape), leaf.dtype)
                for name, leaf in inputs(interface.agents[agent].observation).items()
                if name != ACTION_MASK
            }
            for agent in agents
        ]
        self._present = np.zeros((num_envs, len(agents)), np.int8)

    def extended(self, turn: Turn) -> Turn:
        """See CentralObserver."""
        over = np.concatenate([turn.crashed, turn.finished])
        self._forget(turn.crashed)
        for rows in turn.endings:
            self._store(rows.envs, rows.agents, rows.observations)
        if turn.endings:
            # An agent that leaves an episode is valued with what the others observe at the same time.
            for batch in turn.batches.values():
                continuing = batch.rows(batch.without(over))
                self._store(continuing.envs, continuing.agents, continuing.observations)
        endings = [
            replace(rows, observations={**rows.observations, **self._columns(rows.envs)}) for rows in turn.endings
        ]
        for rows in turn.endings:
            for agent in np.unique(rows.agents).tolist():
                for column in self._latest[agent].values():
                    column[rows.envs[rows.agents == agent]] = 0
            self._present[rows.envs, rows.agents] = 0
        self._forget(turn.finished)
        for batch in turn.batches.values():
            self._store(batch.envs, batch.agents, batch.observations)
        batches = {
            group: replace(batch, observations=batch.observations | self._columns(batch.envs))
            for group, batch in turn.batches.items()
        }
        return replace(turn, batches=batches, endings=endings)

    def _columns(self, envs: Indices) -> dict[str, NDArray]:
        columns = {
            f"{CENTRAL}{agent}/{name}": column[envs]
            for agent, latest in zip(self._agents, self._latest, strict=True)
            for name, column in latest.items()
        }
        return columns | {PRESENT: self._present[envs]}

    def _store(self, envs: Indices, agents: Indices, observations: Mapping[str, NDArray]) -> None:
        for agent in np.unique(agents).tolist():
            rows = np.flatnonzero(agents == agent)
            for name, column in self._latest[agent].items():
                column[envs[rows]] = observations[name][rows]
        self._present[envs, agents] = 1

    def _forget(self, envs: Indices) -> None:
        for latest in self._latest:
            for column in latest.values():
                column[envs] = 0
        self._present[envs] = 0


class GlobalStates:
    """The environments' own states."""

    def __init__(self, num_envs: int) -> None:
        self._num_envs = num_envs

    def extended(self, turn: Turn) -> Turn:
        """See CentralObserver."""
        current = [states for states in (turn.states, turn.last_states) if states is not None]
        values = np.zeros((self._num_envs, current[0].values.shape[1] if current else 0), np.float32)
        # Agents of a finished episode are valued with its last state; the next episode has already started.
        endings_values = values.copy()
        if turn.states is not None:
            values[turn.states.envs] = turn.states.values
        for states in current:
            endings_values[states.envs] = states.values
        batches = {
            group: replace(batch, observations=batch.observations | {STATE: values[batch.envs]})
            for group, batch in turn.batches.items()
        }
        endings = [
            replace(rows, observations={**rows.observations, STATE: endings_values[rows.envs]}) for rows in turn.endings
        ]
        return replace(turn, batches=batches, endings=endings)


def central_observer(
    critic: Critic, interface: Interface, agents: Sequence[str], num_envs: int
) -> CentralObserver | None:
    """Return what adds the columns of a critic; None if it gets its own agent's observation only."""
    if critic == "own":
        return None
    return JointObservations(interface, agents, num_envs) if critic == "central" else GlobalStates(num_envs)


def central_space(critic: Critic, environment: EnvironmentConfig, interface: Interface) -> dict[str, gymnasium.Space]:
    """Return the spaces of the columns that a critic gets besides its own agent's observation.

    Raises ConfigError if the environment has no global state, or cannot be created.
    """
    if critic == "state":
        size = own_state_size(environment)
        if size is None:
            raise ConfigError("training.critic: state needs an environment with a method state(): use central")
        return {STATE: gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float32)}
    observed = {
        f"{CENTRAL}{agent}/{name}": to_gymnasium(leaf)
        for agent, spaces in interface.agents.items()
        for name, leaf in inputs(spaces.observation).items()
        if name != ACTION_MASK
    }
    return {**observed, PRESENT: gymnasium.spaces.MultiBinary(len(interface.agents))}
