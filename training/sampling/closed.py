"""Closed transitions for replay: each from an agent's action to its own next row, or its ending.

Columns of `OwnTransitions`, a block for each policy, rows (k, …):

| `observations/<input>` | in the environment's dtype; `action_mask` is an input like others |
| `actions` | raw: (k,) int64 or (k, m) float32, see league/policies/actions.py |
| `rewards` | float32, all since the action; in a turn-based game also those of others' moves |
| `terminated`, `truncated` | of the agent; truncated alone is bootstrapped |
| `next_observations/<input>` | at the agent's own next turn, or the last one of its episode |
| `memory/<key>` | of a policy with a memory: the state before the action |

Columns of `JointTransitions`, one block for all policies, a row per step of a copy. Policy p has n_p agents, in the
order of the environment's `possible_agents`, and each of its columns an axis for them:

| `observations/<p>/<input>`, `next_observations/<p>/<input>` | (k, n_p, …); zeros for an agent that is not there |
| `actions/<p>` | (k, n_p) or (k, n_p, m) |
| `rewards/<p>`, `terminated/<p>`, `truncated/<p>` | (k, n_p) |
| `memory/<p>/<key>` | (k, n_p, width) |
| `present/<p>` | (k, n_p) bool: whether the agent acted; nothing else of it counts where it did not |
| `state`, `next_state` | (k, s) float32: the environment's own, else all observations of all agents but masks, flat |

`next_state` of a finished episode is the state that it ended in, not the next one's first.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from league.config import EnvironmentConfig
from league.environments.lockstep import stepping
from league.environments.stepping import Episode, Turn
from league.errors import EnvironmentMismatch
from league.interface import AgentInterface, Interface
from league.spaces import ACTION_MASK, Box, Discrete, MultiDiscrete, inputs
from training.replay import NEXT, Block, Rows
from training.sampling.reset_seeds import ResetSeeds

OBSERVATIONS, ACTIONS, REWARDS, TERMINATED, TRUNCATED = "observations", "actions", "rewards", "terminated", "truncated"
PRESENT, STATE, MEMORY = "present", "state", "memory"
JOINT = "joint"
"""The key of the buffer of joint transitions, where there would be a policy's id."""
Initial = Mapping[str, Mapping[str, NDArray]]
"""Policy id → its state before an episode, key → (width,); empty without a memory."""
NO_MEMORY: Initial = {}


@dataclass
class _Open:
    """What the agents of a policy saw last and did there. A place is copy · n_p + the agent's number in its policy."""

    is_open: NDArray
    is_first: NDArray
    observations: Rows = field(default_factory=dict)
    memory: Rows = field(default_factory=dict)
    actions: NDArray | None = None
    places: NDArray = field(default_factory=lambda: np.zeros(0, np.int64))
    """Of the rows that must act now."""


class OwnTransitions:
    """Each policy's own transitions, in the order in which they were closed."""

    def __init__(self, interface: Interface, agents: Sequence[str], copies: int, initial: Initial = NO_MEMORY) -> None:
        self._copies, self._initial = copies, initial
        self._policies = interface.policy_ids
        by_agent = [interface.policies[agent] for agent in agents]
        self._policy_of = by_agent
        self._number = [by_agent[:i].count(policy) for i, policy in enumerate(by_agent)]
        self._sizes = {policy: by_agent.count(policy) for policy in self._policies}
        self._stream_offset = 0
        self._closed: dict[str, list[Block]] = {policy: [] for policy in self._policies}

    def begin(self, seeds: ResetSeeds) -> None:
        self._stream_offset = seeds.runner * self._copies

    def restart(self) -> None:
        self._open = {
            policy: _Open(
                np.zeros(self._copies * n, dtype=bool),
                np.ones(self._copies * n, dtype=bool),
                memory={
                    key: np.stack([each] * self._copies * n) for key, each in self._initial.get(policy, {}).items()
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
        log_p: NDArray,  # noqa: ARG002  # off-policy learners have no use for it
        dist_inputs: NDArray,  # noqa: ARG002
        state: Mapping[str, NDArray] | None,
    ) -> None:
        own = self._open[policy]
        for key, kept in own.memory.items():
            assert state is not None, "a policy with a memory has a state"
            kept[own.places] = state[key]
        if own.actions is None:
            own.actions = np.zeros((len(own.is_open), *raw.shape[1:]), raw.dtype)
        own.actions[own.places] = raw
        own.is_open[own.places] = True

    def cut(self) -> dict[str, Block]:
        """Policy id → what was closed since the last cut; policies without any are left out."""
        cut = {policy: joined(blocks) for policy, blocks in self._closed.items() if blocks}
        self._closed = {policy: [] for policy in self._policies}
        return cut

    def close(self, turn: Turn) -> dict[str, Block]:
        """What a turn closes; then its rows are what agents saw last."""
        for copy in turn.crashed:
            for policy, n in self._sizes.items():
                left = slice(copy * n, (copy + 1) * n)
                self._open[policy].is_open[left] = False
                self._open[policy].is_first[left] = True
        closed: dict[str, list[Block]] = {policy: [] for policy in self._policies}
        self._close_endings(turn, closed)
        for own in self._open.values():
            own.places = own.places[:0]
        for group, batch in turn.batches.items():
            if not isinstance(group, str):
                continue
            numbers = np.array([self._number[agent] for agent in batch.agents], dtype=np.int64)
            places = np.array(batch.copies, dtype=np.int64) * self._sizes[group] + numbers
            rewards, unended = np.array(batch.rewards, dtype=np.float32), np.zeros(len(places), dtype=bool)
            self._close(group, places, batch.observations, rewards, unended, unended, closed)
            self._see(group, places, batch.observations)
        return {policy: joined(blocks) for policy, blocks in closed.items() if blocks}

    def _close_endings(self, turn: Turn, closed: dict[str, list[Block]]) -> None:
        for policy in self._policies:
            endings = [ending for ending in turn.endings if self._policy_of[ending.agent] == policy]
            if not endings:
                continue
            n = self._sizes[policy]
            places = np.array([ending.copy * n + self._number[ending.agent] for ending in endings], dtype=np.int64)
            observations = {
                name: np.stack([ending.observation[name] for ending in endings]) for name in endings[0].observation
            }
            rewards = np.array([ending.reward for ending in endings], dtype=np.float32)
            terminated = np.array([ending.terminated for ending in endings], dtype=bool)
            truncated = np.array([ending.truncated for ending in endings], dtype=bool) & ~terminated
            self._close(policy, places, observations, rewards, terminated, truncated, closed)
            self._open[policy].is_open[places] = False
            self._open[policy].is_first[places] = True

    def _close(
        self,
        policy: str,
        places: NDArray,
        observations: Rows,
        rewards: NDArray,
        terminated: NDArray,
        truncated: NDArray,
        closed: dict[str, list[Block]],
    ) -> None:
        own = self._open[policy]
        chosen = np.flatnonzero(own.is_open[places])
        if not len(chosen):
            return
        places = places[chosen]
        assert own.actions is not None, "an open place has acted"
        rows = {f"{OBSERVATIONS}/{name}": seen[places] for name, seen in own.observations.items()}
        rows |= {f"{MEMORY}/{key}": before[places] for key, before in own.memory.items()}
        rows |= {ACTIONS: own.actions[places], REWARDS: rewards[chosen]}
        rows |= {TERMINATED: terminated[chosen], TRUNCATED: truncated[chosen]}
        rows |= {
            f"{NEXT}{OBSERVATIONS}/{name}": np.asarray(observations[name])[chosen].astype(seen.dtype, copy=False)
            for name, seen in own.observations.items()
        }
        streams = self._stream_offset * self._sizes[policy] + places
        closed[policy].append(Block(rows, streams, own.is_first[places]))
        own.is_first[places] = False
        own.is_open[places] = False

    def _see(self, policy: str, places: NDArray, observations: Rows) -> None:
        own = self._open[policy]
        if not own.observations:
            own.observations = {
                name: np.zeros((len(own.is_open), *rows.shape[1:]), rows.dtype) for name, rows in observations.items()
            }
        for name, rows in observations.items():
            own.observations[name][places] = rows
        own.places = places

    def sizes(self) -> dict[str, int]:
        """n_p: policy id → its agents."""
        return dict(self._sizes)

    def still_open(self, copies: NDArray) -> bool:
        """Whether an agent of these copies has acted, and waits."""
        return any(
            own.is_open.reshape(self._copies, self._sizes[policy])[copies].any() for policy, own in self._open.items()
        )


class JointTransitions:
    """All agents' transitions of one step of a copy as one row. All that are there must act at once."""

    keeps_states = True

    def __init__(self, interface: Interface, agents: Sequence[str], copies: int, initial: Initial = NO_MEMORY) -> None:
        self._own = OwnTransitions(interface, agents, copies, initial)
        self._copies = copies
        self._stream_offset = 0
        self._closed: list[Block] = []
        self._states: NDArray | None = None
        self._empty = {
            policy: _no_rows(interface.of_policy(policy), initial.get(policy, {})) for policy in interface.policy_ids
        }

    def begin(self, seeds: ResetSeeds) -> None:
        self._own.begin(seeds)
        self._stream_offset = seeds.runner * self._copies

    def restart(self) -> None:
        self._own.restart()

    def read(self, turn: Turn) -> None:
        """Raises EnvironmentMismatch where agents take turns."""
        own = self._own.close(turn)
        if own:
            copies = np.unique(np.concatenate([self._copies_of(policy, block) for policy, block in own.items()]))
            if self._own.still_open(copies):
                raise EnvironmentMismatch(
                    "agents of one step get their next observations at different times: joint transitions need an"
                    " environment in which all agents act at once"
                )
            self._closed.append(self._together(copies, own, turn))
        self._keep_states(turn)

    def act(
        self, policy: str, raw: NDArray, log_p: NDArray, dist_inputs: NDArray, state: Mapping[str, NDArray] | None
    ) -> None:
        self._own.act(policy, raw, log_p, dist_inputs, state)

    def cut(self) -> dict[str, Block]:
        """{JOINT: what was closed since the last cut}, empty without any."""
        closed, self._closed = self._closed, []
        return {JOINT: joined(closed)} if closed else {}

    def _copies_of(self, policy: str, block: Block) -> NDArray:
        return block.streams // self._own.sizes()[policy] - self._stream_offset

    def _together(self, copies: NDArray, own: Mapping[str, Block], turn: Turn) -> Block:
        rows: Rows = {}
        firsts = np.zeros(len(copies), dtype=bool)
        for policy, n in self._own.sizes().items():
            block = own.get(policy, self._empty[policy])
            places = np.searchsorted(copies, self._copies_of(policy, block)), block.streams % n
            firsts[places[0]] |= block.firsts
            rows[f"{PRESENT}/{policy}"] = np.zeros((len(copies), n), dtype=bool)
            rows[f"{PRESENT}/{policy}"][places] = True
            for name, column in block.rows.items():
                head, _, rest = name.partition("/")
                whole = np.zeros((len(copies), n, *column.shape[1:]), column.dtype)
                whole[places] = column
                rows["/".join(filter(None, (head, policy, rest)))] = whole
        if self.keeps_states:
            rows |= self._with_states(copies, rows, turn)
        return Block(rows, self._stream_offset + copies, firsts)

    def _with_states(self, copies: NDArray, rows: Rows, turn: Turn) -> Rows:
        if self._states is None:
            return {STATE: _flat(rows, OBSERVATIONS), NEXT + STATE: _flat(rows, NEXT + OBSERVATIONS)}
        after = np.stack(
            [(turn.last_states if copy in turn.last_states else turn.states)[copy] for copy in copies.tolist()]
        )
        return {STATE: self._states[copies], NEXT + STATE: after}

    def _keep_states(self, turn: Turn) -> None:
        for copy, state in turn.states.items():
            if self._states is None:
                self._states = np.zeros((self._copies, len(state)), np.float32)
            self._states[copy] = state


class JointWithoutStates(JointTransitions):
    """Without the columns `state` and `next_state`: what agents see and do is enough."""

    keeps_states = False


def state_size(environment: EnvironmentConfig, interface: Interface) -> int:
    """s: how many numbers `state` has in an environment. Raises ConfigError for one that cannot be made."""
    batched = stepping(environment, 1, states=True)
    try:
        turn = batched.start(lambda _: Episode(0, list(interface.policies.values())))
    finally:
        batched.close()
    if turn.states:
        return len(turn.states[0])
    return sum(
        math.prod(leaf.shape)
        for agent in interface.agents
        for name, leaf in inputs(interface.agents[agent].observation).items()
        if name != ACTION_MASK
    )


def joined(blocks: Sequence[Block]) -> Block:
    """Blocks of the same columns, one behind another."""
    if len(blocks) == 1:
        return blocks[0]
    return Block(
        {name: np.concatenate([block.rows[name] for block in blocks]) for name in blocks[0].rows},
        np.concatenate([block.streams for block in blocks]),
        np.concatenate([block.firsts for block in blocks]),
    )


def _no_rows(spaces: AgentInterface, initial: Mapping[str, NDArray]) -> Block:
    """The columns of a policy, of whose agents none is there."""
    seen = {name: np.zeros((0, *leaf.shape), leaf.dtype) for name, leaf in inputs(spaces.observation).items()}
    rows: Rows = {f"{OBSERVATIONS}/{name}": column for name, column in seen.items()}
    rows |= {f"{MEMORY}/{key}": np.zeros((0, *each.shape), each.dtype) for key, each in initial.items()}
    match spaces.action:
        case Discrete():
            rows[ACTIONS] = np.zeros(0, np.int64)
        case MultiDiscrete(nvec=nvec):
            rows[ACTIONS] = np.zeros((0, np.size(nvec)), np.int64)
        case Box(shape=shape):
            rows[ACTIONS] = np.zeros((0, math.prod(shape)), np.float32)
    rows |= {REWARDS: np.zeros(0, np.float32), TERMINATED: np.zeros(0, bool), TRUNCATED: np.zeros(0, bool)}
    rows |= {f"{NEXT}{OBSERVATIONS}/{name}": column for name, column in seen.items()}
    return Block(rows, np.zeros(0, np.int64), np.zeros(0, bool))


def _flat(rows: Rows, head: str) -> NDArray:
    parts = [
        column.reshape(len(column), -1).astype(np.float32)
        for name, column in rows.items()
        if name.startswith(f"{head}/") and not name.endswith(f"/{ACTION_MASK}")
    ]
    return np.concatenate(parts, axis=1)
