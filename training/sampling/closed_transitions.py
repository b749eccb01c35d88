"""Records transitions for replay: each from an agent's action to its own next observation, or to its end.

Columns of `PolicyTransitions`, one block per policy, rows (k, …):

| `observations/<input>` | in the environment's dtype; `action_mask` is an input like any other |
| `actions` | raw: (k,) int64 or (k, m) float32, see league/policies/actions.py |
| `rewards` | float32, sum since the action; in turn-based games it includes other agents' moves |
| `terminated`, `truncated` | of the agent; only truncated agents are bootstrapped |
| `next_observations/<input>` | at the agent's own next turn, or its last observation |
| `recurrent_state/<key>` | of a recurrent policy: the state before the action |

Columns of `JointTransitions`, one block for all policies, one row per step of an environment. Policy p has n_p agents,
in the order of the environment's `possible_agents`, as an additional axis of its columns:

| `observations/<p>/<input>`, `next_observations/<p>/<input>` | (k, n_p, …); zeros for absent agents |
| `actions/<p>` | (k, n_p) or (k, n_p, m) |
| `rewards/<p>`, `terminated/<p>`, `truncated/<p>` | (k, n_p) |
| `recurrent_state/<p>/<key>` | (k, n_p, width) |
| `present/<p>` | (k, n_p) bool: whether the agent acted; otherwise its other columns are meaningless |
| `state`, `next_state` | (k, s) float32: the environment's own, else all flattened observations without masks |

`next_state` of a finished episode is the state in which it ended, not the next episode's first.
"""

import math
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from league.config.environment import EnvironmentConfig
from league.environments.implementation import stock_stepping
from league.environments.stepping import Turn, each_agent_alone
from league.errors import EnvironmentMismatch
from league.interface import AgentInterface, Interface
from league.spaces import ACTION_MASK, Box, Discrete, MultiDiscrete, inputs
from training.replay_buffer import NEXT, Rows, TransitionBlock
from training.sampling.reset_seeds import ResetSeeds

OBSERVATIONS, ACTIONS, REWARDS, TERMINATED, TRUNCATED = "observations", "actions", "rewards", "terminated", "truncated"
PRESENT, STATE, RECURRENT_STATE = "present", "state", "recurrent_state"
JOINT = "joint"
"""The key of the buffer of joint transitions, in place of a policy id."""
Initial = Mapping[str, Mapping[str, NDArray]]
"""Policy id → initial recurrent state, key → (width,); empty if not recurrent."""
STATELESS: Initial = {}


@dataclass
class _OpenTransitions:
    """The last observations and actions of a policy's agents. A place is env · n_p + index of the agent in its
    policy."""

    is_open: NDArray
    is_first: NDArray
    observations: Rows = field(default_factory=dict)
    recurrent_state: Rows = field(default_factory=dict)
    actions: NDArray | None = None
    places: NDArray = field(default_factory=lambda: np.zeros(0, np.int64))
    """Places of the rows that must act now."""


class PolicyTransitions:
    """Records each policy's own transitions, in the order in which they are completed."""

    def __init__(
        self, interface: Interface, agents: Sequence[str], num_envs: int, initial: Initial = STATELESS
    ) -> None:
        self._num_envs, self._initial = num_envs, initial
        self._policies = interface.policy_ids
        by_agent = [interface.policies[agent] for agent in agents]
        self._policy_of = np.array([self._policies.index(policy) for policy in by_agent])
        self._number = np.array([by_agent[:i].count(policy) for i, policy in enumerate(by_agent)])
        self._sizes = {policy: by_agent.count(policy) for policy in self._policies}
        self._stream_offset = 0
        self._closed: dict[str, list[TransitionBlock]] = {policy: [] for policy in self._policies}

    def begin(self, seeds: ResetSeeds) -> None:
        self._stream_offset = seeds.runner * self._num_envs

    def restart(self) -> None:
        self._open = {
            policy: _OpenTransitions(
                np.zeros(self._num_envs * n, dtype=bool),
                np.ones(self._num_envs * n, dtype=bool),
                recurrent_state={
                    key: np.stack([state] * self._num_envs * n) for key, state in self._initial.get(policy, {}).items()
                },
            )
            for policy, n in self._sizes.items()
        }

    def read(self, turn: Turn) -> None:
        for policy, block in self.close(turn).items():
            self._closed[policy].append(block)

    def act(
        self,
        policy: str,
        raw: NDArray,
        log_p: NDArray,  # noqa: ARG002  # off-policy learners do not use it
        dist_inputs: NDArray,  # noqa: ARG002
        state: Mapping[str, NDArray] | None,
    ) -> None:
        open_transitions = self._open[policy]
        for key, kept in open_transitions.recurrent_state.items():
            assert state is not None, "a recurrent policy has a state"
            kept[open_transitions.places] = state[key]
        if open_transitions.actions is None:
            open_transitions.actions = np.zeros((len(open_transitions.is_open), *raw.shape[1:]), raw.dtype)
        open_transitions.actions[open_transitions.places] = raw
        open_transitions.is_open[open_transitions.places] = True

    def cut(self) -> dict[str, TransitionBlock]:
        """Return policy id → transitions completed since the last cut; policies without any are left out."""
        cut = {policy: concatenate(blocks) for policy, blocks in self._closed.items() if blocks}
        self._closed = {policy: [] for policy in self._policies}
        return cut

    def close(self, turn: Turn) -> dict[str, TransitionBlock]:
        """Return the transitions that a turn completes, and store its rows as the latest observations."""
        for policy, n in self._sizes.items():
            crashed_places = (turn.crashed[:, np.newaxis] * n + np.arange(n)).ravel()
            self._open[policy].is_open[crashed_places] = False
            self._open[policy].is_first[crashed_places] = True
        closed: dict[str, list[TransitionBlock]] = {policy: [] for policy in self._policies}
        for rows in turn.endings:
            policies = self._policy_of[rows.agents]
            for number in np.unique(policies).tolist():
                policy, indices = self._policies[number], np.flatnonzero(policies == number)
                places = rows.envs[indices] * self._sizes[policy] + self._number[rows.agents[indices]]
                observations = {name: array[indices] for name, array in rows.observations.items()}
                rewards, terminated = rows.rewards[indices].astype(np.float32), rows.terminations[indices]
                truncated = rows.truncations[indices] & ~terminated
                self._close(policy, places, observations, rewards, terminated, truncated, closed)
                self._open[policy].is_open[places] = False
                self._open[policy].is_first[places] = True
        for open_transitions in self._open.values():
            open_transitions.places = open_transitions.places[:0]
        for group, batch in turn.batches.items():
            if group >= len(self._policies):
                continue
            policy = self._policies[group]
            places = batch.envs * self._sizes[policy] + self._number[batch.agents]
            rewards, unended = batch.rewards.astype(np.float32), np.zeros(len(places), dtype=bool)
            self._close(policy, places, batch.observations, rewards, unended, unended, closed)
            open_transitions = self._open[policy]
            open_transitions.places = places
            if not open_transitions.observations:
                open_transitions.observations = {
                    name: np.zeros((len(open_transitions.is_open), *column.shape[1:]), column.dtype)
                    for name, column in batch.observations.items()
                }
            for name, column in batch.observations.items():
                open_transitions.observations[name][places] = column
        return {policy: concatenate(blocks) for policy, blocks in closed.items() if blocks}

    def _close(
        self,
        policy: str,
        places: NDArray,
        observations: Rows,
        rewards: NDArray,
        terminated: NDArray,
        truncated: NDArray,
        closed: dict[str, list[TransitionBlock]],
    ) -> None:
        open_transitions = self._open[policy]
        indices = np.flatnonzero(open_transitions.is_open[places])
        if not len(indices):
            return
        places = places[indices]
        assert open_transitions.actions is not None, "an open place has acted"
        rows = {f"{OBSERVATIONS}/{name}": column[places] for name, column in open_transitions.observations.items()}
        rows |= {f"{RECURRENT_STATE}/{key}": before[places] for key, before in open_transitions.recurrent_state.items()}
        rows |= {ACTIONS: open_transitions.actions[places], REWARDS: rewards[indices]}
        rows |= {TERMINATED: terminated[indices], TRUNCATED: truncated[indices]}
        rows |= {
            f"{NEXT}{OBSERVATIONS}/{name}": observations[name][indices].astype(column.dtype, copy=False)
            for name, column in open_transitions.observations.items()
        }
        streams = self._stream_offset * self._sizes[policy] + places
        closed[policy].append(TransitionBlock(rows, streams, open_transitions.is_first[places]))
        open_transitions.is_first[places] = False
        open_transitions.is_open[places] = False

    def sizes(self) -> dict[str, int]:
        """Return policy id → number of its agents, n_p."""
        return dict(self._sizes)

    def still_open(self, envs: NDArray) -> bool:
        """Return whether an agent of these environments has acted and has no next observation yet."""
        return any(
            open_transitions.is_open.reshape(self._num_envs, self._sizes[policy])[envs].any()
            for policy, open_transitions in self._open.items()
        )


class JointTransitions:
    """Records the transitions of all agents in one step as one row. All present agents must act simultaneously."""

    keeps_states = True

    def __init__(
        self, interface: Interface, agents: Sequence[str], num_envs: int, initial: Initial = STATELESS
    ) -> None:
        self._own = PolicyTransitions(interface, agents, num_envs, initial)
        self._num_envs = num_envs
        self._stream_offset = 0
        self._closed: list[TransitionBlock] = []
        self._states: NDArray | None = None
        self._empty = {
            policy: _empty_block(interface.of_policy(policy), initial.get(policy, {}))
            for policy in interface.policy_ids
        }

    def begin(self, seeds: ResetSeeds) -> None:
        self._own.begin(seeds)
        self._stream_offset = seeds.runner * self._num_envs

    def restart(self) -> None:
        self._own.restart()

    def read(self, turn: Turn) -> None:
        """Raises EnvironmentMismatch if agents take turns."""
        blocks = self._own.close(turn)
        if blocks:
            envs = np.unique(np.concatenate([self._envs_of(policy, block) for policy, block in blocks.items()]))
            if self._own.still_open(envs):
                raise EnvironmentMismatch(
                    "the agents of one step receive their next observations at different times: joint transitions"
                    " require an environment in which all agents act at once"
                )
            self._closed.append(self._joint_rows(envs, blocks, turn))
        if turn.states is not None:
            if self._states is None:
                self._states = np.zeros((self._num_envs, turn.states.values.shape[1]), np.float32)
            self._states[turn.states.envs] = turn.states.values

    def act(
        self, policy: str, raw: NDArray, log_p: NDArray, dist_inputs: NDArray, state: Mapping[str, NDArray] | None
    ) -> None:
        self._own.act(policy, raw, log_p, dist_inputs, state)

    def cut(self) -> dict[str, TransitionBlock]:
        """Return {JOINT: transitions completed since the last cut}; empty if there are none."""
        closed, self._closed = self._closed, []
        return {JOINT: concatenate(closed)} if closed else {}

    def _envs_of(self, policy: str, block: TransitionBlock) -> NDArray:
        return block.streams // self._own.sizes()[policy] - self._stream_offset

    def _joint_rows(self, envs: NDArray, own: Mapping[str, TransitionBlock], turn: Turn) -> TransitionBlock:
        rows: Rows = {}
        firsts = np.zeros(len(envs), dtype=bool)
        for policy, n in self._own.sizes().items():
            block = own.get(policy, self._empty[policy])
            places = np.searchsorted(envs, self._envs_of(policy, block)), block.streams % n
            firsts[places[0]] |= block.firsts
            rows[f"{PRESENT}/{policy}"] = np.zeros((len(envs), n), dtype=bool)
            rows[f"{PRESENT}/{policy}"][places] = True
            for name, column in block.rows.items():
                head, _, tail = name.partition("/")
                whole = np.zeros((len(envs), n, *column.shape[1:]), column.dtype)
                whole[places] = column
                rows["/".join(filter(None, (head, policy, tail)))] = whole
        if self.keeps_states and self._states is None:
            rows |= {STATE: _flat_state(rows, OBSERVATIONS), NEXT + STATE: _flat_state(rows, NEXT + OBSERVATIONS)}
        elif self.keeps_states and self._states is not None:
            after = self._states.copy()
            for states in (turn.states, turn.last_states):
                if states is not None:
                    after[states.envs] = states.values
            rows |= {STATE: self._states[envs], NEXT + STATE: after[envs]}
        return TransitionBlock(rows, self._stream_offset + envs, firsts)


class JointTransitionsWithoutState(JointTransitions):
    """Joint transitions without the columns `state` and `next_state`."""

    keeps_states = False


def own_state_size(environment: EnvironmentConfig) -> int | None:
    """Return the size of an environment's `state()`; None if it has none.

    Raises ConfigError if the environment cannot be created.
    """
    if environment.external is not None:
        return None
    with closing(stock_stepping(environment, 1, states=True)) as batched:
        turn = batched.start(each_agent_alone([0], len(batched.agents)))
    return None if turn.states is None else turn.states.values.shape[1]


def state_size(environment: EnvironmentConfig, interface: Interface) -> int:
    """Return s, the size of `state` in an environment. Raises what `own_state_size` raises."""
    size = own_state_size(environment)
    if size is not None:
        return size
    return sum(
        math.prod(leaf.shape)
        for agent in interface.agents
        for name, leaf in inputs(interface.agents[agent].observation).items()
        if name != ACTION_MASK
    )


def concatenate(blocks: Sequence[TransitionBlock]) -> TransitionBlock:
    """Concatenate blocks that have the same columns."""
    if len(blocks) == 1:
        return blocks[0]
    return TransitionBlock(
        {name: np.concatenate([block.rows[name] for block in blocks]) for name in blocks[0].rows},
        np.concatenate([block.streams for block in blocks]),
        np.concatenate([block.firsts for block in blocks]),
    )


def _empty_block(spaces: AgentInterface, initial: Mapping[str, NDArray]) -> TransitionBlock:
    """Return the columns of a policy without rows."""
    columns = {name: np.zeros((0, *leaf.shape), leaf.dtype) for name, leaf in inputs(spaces.observation).items()}
    rows: Rows = {f"{OBSERVATIONS}/{name}": column for name, column in columns.items()}
    rows |= {f"{RECURRENT_STATE}/{key}": np.zeros((0, *state.shape), state.dtype) for key, state in initial.items()}
    match spaces.action:
        case Discrete():
            rows[ACTIONS] = np.zeros(0, np.int64)
        case MultiDiscrete(nvec=nvec):
            rows[ACTIONS] = np.zeros((0, np.size(nvec)), np.int64)
        case Box(shape=shape):
            rows[ACTIONS] = np.zeros((0, math.prod(shape)), np.float32)
    rows |= {REWARDS: np.zeros(0, np.float32), TERMINATED: np.zeros(0, bool), TRUNCATED: np.zeros(0, bool)}
    rows |= {f"{NEXT}{OBSERVATIONS}/{name}": column for name, column in columns.items()}
    return TransitionBlock(rows, np.zeros(0, np.int64), np.zeros(0, bool))


def _flat_state(rows: Rows, head: str) -> NDArray:
    parts = [
        column.reshape(len(column), -1).astype(np.float32)
        for name, column in rows.items()
        if name.startswith(f"{head}/") and name != f"{head}/{ACTION_MASK}"
    ]
    return np.concatenate(parts, axis=1)
