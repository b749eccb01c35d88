"""Records sampled steps as episode chunks for learners.

An agent's transition is open from its action until its own next row or its end; its reward is the sum of all rewards in
between. Transitions that are open when a sample is cut are carried over to the next sample, whose chunk starts at the
same row: no step is lost or counted twice, and a cut chunk is bootstrapped from an observation that the agent received.
"""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from league.config.ppo import Critic
from league.environments.stepping import Indices, Turn
from league.environments.vector.vector_env import AgentRows
from league.interface import Interface
from training.sampling.central_observations import CENTRAL, central_observer
from training.sampling.episode_chunks import EpisodeChunks
from training.sampling.reset_seeds import ResetSeeds

Rows = dict[str, NDArray]
"""Column → its rows, (k, …)."""

ACTIONS, LOG_P, DIST_INPUTS = "actions", "log_p", "dist_inputs"
STATE_PREFIX = "state/"
"""Prefix of the columns of recurrent states."""
NO_ROW = -1


@dataclass(frozen=True, slots=True)
class EpisodeEnds:
    """Ends of k agents' parts of episodes, after `after` rows have been observed.

    slots, rewards, terminated, truncated: (k,). observations: after the last action; None if the episodes are lost.
    """

    after: int
    slots: Indices
    rewards: NDArray[np.float64]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    observations: Mapping[str, NDArray] | None


@dataclass(frozen=True, slots=True)
class ChunkLayout:
    """The rows and endings of a sample sorted by slot, and the boundaries of chunks.

    rows: indices of the observations. rewards: received with them. For each of c chunks: firsts and lasts, the
    positions of its first and last row; slots; started, steps of its episode before the chunk; ends, the index of what
    ended it among all ends, -1 if it is open; is_lost, whether its episode is lost.
    """

    rows: Indices
    rewards: NDArray[np.float64]
    firsts: Indices
    lasts: Indices
    slots: Indices
    started: Indices
    ends: Indices
    is_lost: NDArray[np.bool_]

    @property
    def steps(self) -> Indices:
        """The number of steps of each chunk, (c,)."""
        return self.lasts - self.firsts


class ChunkBuilder:
    """Builds the chunks of one policy in all environments. A slot is an agent of an environment: env · agents + agent.

    Order of calls: `end` and `discard` for what has ended, `observe` with the rows that must act, `act` with the
    actions; `cut` anywhere between `observe` and `act`.
    """

    def __init__(self, policy: str, agents: int, num_envs: int) -> None:
        self._policy, self._agents = policy, agents
        self._started = np.zeros(num_envs * agents, dtype=np.int64)
        self._slots: list[Indices] = []
        self._rewards: list[NDArray] = []
        self._observations: list[Mapping[str, NDArray]] = []
        self._plays: list[Rows] = []
        self._ends: list[EpisodeEnds] = []
        self._observed = 0

    def observe(self, slots: Indices, rewards: NDArray, observations: Mapping[str, NDArray]) -> None:
        """Add the next rows, (k,) each and ONNX input name → (k, …). They close their agents' open transitions."""
        self._slots.append(slots)
        self._rewards.append(rewards)
        self._observations.append(observations)
        self._observed += len(slots)

    def act(self, raw: NDArray, log_p: NDArray, dist_inputs: NDArray, state: Mapping[str, NDArray] | None) -> None:
        """Add the actions on the rows of the last `observe`.

        Args:
            raw: Raw actions, (k,) or (k, m).
            log_p: (k,).
            dist_inputs: (k, d).
            state: Recurrent states before the actions, key → (k, width).
        """
        play = {ACTIONS: raw, LOG_P: log_p, DIST_INPUTS: dist_inputs}
        self._plays.append(play | {STATE_PREFIX + key: value for key, value in (state or {}).items()})

    def end(self, rows: AgentRows, own: NDArray) -> None:
        """Add that agents have left their episodes, whoever controlled them. own: indices of some of the rows."""
        slots = rows.envs[own] * self._agents + rows.agents[own]
        terminated = rows.terminations[own]
        observations = {name: array[own] for name, array in rows.observations.items()}
        self._ends.append(
            EpisodeEnds(
                self._observed, slots, rows.rewards[own], terminated, rows.truncations[own] & ~terminated, observations
            )
        )

    def discard(self, envs: Indices) -> None:
        """Drop what was observed of the current episodes of `envs` since the last cut: they have no end."""
        slots = (envs[:, np.newaxis] * self._agents + np.arange(self._agents)).ravel()
        nothing = np.zeros(len(slots), dtype=bool)
        self._ends.append(EpisodeEnds(self._observed, slots, np.zeros(len(slots)), nothing, nothing, None))

    def cut(self, name: str) -> EpisodeChunks | None:
        """Return all transitions closed since the last cut as chunks; None if there are none."""
        ends, self._ends = self._ends, []
        if not self._observed:
            return None
        layout = self._layout(ends)
        finals = [end.observations for end in ends if end.observations is not None]
        observations, played = _stack([*self._observations, *finals]), _stack(self._plays)
        chunks = self._chunks(name, layout, ends, observations, played)
        # The next sample starts with the last row of each open chunk. Rows with actions come first, since the rows that
        # must act next were observed last.
        is_open = layout.ends == NO_ROW
        self._started[:] = 0
        self._started[layout.slots[is_open]] = (layout.started + layout.steps)[is_open]
        kept = np.sort(layout.rows[layout.lasts[is_open]])
        acted = kept[kept < (len(played[ACTIONS]) if played else 0)]
        self._slots = [np.concatenate(self._slots)[kept]]
        self._rewards = [np.concatenate(self._rewards)[kept]]
        self._observations = [{name: array[kept] for name, array in observations.items()}]
        self._plays = [{name: column[acted] for name, column in played.items()}] if len(acted) else []
        self._observed = len(kept)
        return chunks

    def _layout(self, ends: Sequence[EpisodeEnds]) -> ChunkLayout:
        observed = self._observed
        after = np.repeat([end.after for end in ends], [len(end.slots) for end in ends]).astype(np.int64)
        is_lost = np.repeat([end.observations is None for end in ends], [len(end.slots) for end in ends]).astype(bool)
        # The observations of endings follow those of all rows.
        numbers = np.where(is_lost, NO_ROW, observed - 1 + np.cumsum(~is_lost))
        rows = np.insert(np.arange(observed), after, numbers)
        slots = np.insert(np.concatenate(self._slots), after, _joined([end.slots for end in ends], np.int64))
        gained = _joined([end.rewards for end in ends], np.float64)
        rewards = np.insert(np.concatenate(self._rewards), after, gained)
        which = np.insert(np.full(observed, NO_ROW), after, np.arange(len(after)))
        order = np.argsort(slots, kind="stable")
        rows, slots, rewards, which = rows[order], slots[order], rewards[order], which[order]
        is_other_slot = np.diff(slots) != 0
        lasts = np.flatnonzero(np.append((which[:-1] != NO_ROW) | is_other_slot, True))
        firsts = np.append(0, lasts[:-1] + 1)
        # A chunk that was carried over is the first of its slot; later chunks of the slot are new episodes.
        is_first_of_slot = np.append(True, is_other_slot)[firsts]
        ended = which[lasts]
        return ChunkLayout(
            rows,
            rewards,
            firsts,
            lasts,
            slots[firsts],
            np.where(is_first_of_slot, self._started[slots[firsts]], 0),
            ended,
            np.append(is_lost, False)[ended],
        )

    def _chunks(
        self, name: str, layout: ChunkLayout, ends: Sequence[EpisodeEnds], observations: Rows, played: Rows
    ) -> EpisodeChunks | None:
        """Gather each column once, so that each chunk's rows are adjacent."""
        steps = layout.steps
        # An ending without steps is that of an agent which this policy did not control.
        is_whole = ~layout.is_lost & (steps > 0)
        if not is_whole.any():
            return None
        is_seen = np.repeat(is_whole, steps + 1)
        is_acted, is_rewarded = is_seen.copy(), is_seen.copy()
        is_acted[layout.lasts] = is_rewarded[layout.firsts] = False
        observation_rows, action_rows = layout.rows[is_seen], layout.rows[is_acted]
        # The last element is for open chunks.
        terminated = np.append(_joined([end.terminated for end in ends], np.bool_), False)
        truncated = np.append(_joined([end.truncated for end in ends], np.bool_), False)
        return EpisodeChunks(
            name=name,
            policy=self._policy,
            agents=layout.slots[is_whole] % self._agents,
            started=layout.started[is_whole],
            lengths=steps[is_whole],
            observations={
                name: array[observation_rows] for name, array in observations.items() if not name.startswith(CENTRAL)
            },
            actions=played[ACTIONS][action_rows],
            log_p=played[LOG_P][action_rows],
            dist_inputs=played[DIST_INPUTS][action_rows],
            state={
                name.removeprefix(STATE_PREFIX): column[action_rows]
                for name, column in played.items()
                if name.startswith(STATE_PREFIX)
            },
            rewards=layout.rewards[is_rewarded].astype(np.float32),
            terminated=terminated[layout.ends[is_whole]],
            truncated=truncated[layout.ends[is_whole]],
            central={name: array[observation_rows] for name, array in observations.items() if name.startswith(CENTRAL)},
        )


def _stack(blocks: Sequence[Mapping[str, NDArray]]) -> Rows:
    """Concatenate blocks (k_i, …); no columns without blocks."""
    return {name: np.concatenate([block[name] for block in blocks]) for name in blocks[0]} if blocks else {}


def _joined(columns: Sequence[NDArray], dtype: type) -> NDArray:
    return np.concatenate(columns) if columns else np.zeros(0, dtype)


class Recorder(Protocol):
    """Receives each turn, then the actions of the league's own policies in it.

    Group i of a turn is policy i of the interface. Further groups are controlled by others, and are not recorded.
    """

    def begin(self, seeds: ResetSeeds) -> None:
        """Start a new sequence of episodes; `restart` follows."""

    def restart(self) -> None:
        """Drop all open episodes and their open transitions."""

    def read(self, turn: Turn) -> None:
        """Add the results of the last step, and the rows that must act next."""

    def act(
        self, policy: str, raw: NDArray, log_p: NDArray, dist_inputs: NDArray, state: Mapping[str, NDArray] | None
    ) -> None:
        """Add the actions on a policy's rows of the last turn. For the arguments see `ChunkBuilder.act`."""


class EpisodeRecorder:
    """Records episode chunks, one agent's steps each."""

    def __init__(self, interface: Interface, agents: Sequence[str], num_envs: int, critic: Critic = "own") -> None:
        """critic: for which critic to record what it gets."""
        self._agents, self._num_envs = len(agents), num_envs
        self._new_observer = partial(central_observer, critic, interface, agents, num_envs)
        self._learning = interface.policy_ids
        self._policy_of = np.array([self._learning.index(interface.policies[agent]) for agent in agents])
        self._names: Iterator[str] = iter(())

    def begin(self, seeds: ResetSeeds) -> None:
        self._names = (f"{seeds.runner}-{seeds.steps}-{i}" for i in itertools.count())

    def restart(self) -> None:
        self._builders = [ChunkBuilder(policy, self._agents, self._num_envs) for policy in self._learning]
        self._observer = self._new_observer()

    def read(self, turn: Turn) -> None:
        if self._observer is not None:
            turn = self._observer.extended(turn)
        if len(turn.crashed):
            for builder in self._builders:
                builder.discard(turn.crashed)
        for rows in turn.endings:
            policies = self._policy_of[rows.agents]
            for policy in np.flatnonzero(np.bincount(policies)).tolist():
                self._builders[policy].end(rows, np.flatnonzero(policies == policy))
        for group, batch in turn.batches.items():
            if group < len(self._builders):
                slots = batch.envs * self._agents + batch.agents
                self._builders[group].observe(slots, batch.rewards, batch.observations)

    def act(
        self, policy: str, raw: NDArray, log_p: NDArray, dist_inputs: NDArray, state: Mapping[str, NDArray] | None
    ) -> None:
        self._builders[self._learning.index(policy)].act(raw, log_p, dist_inputs, state)

    def cut(self) -> list[EpisodeChunks]:
        """Return the transitions closed since the last cut, for each policy that has any."""
        cut = [builder.cut(next(self._names)) for builder in self._builders]
        return [chunks for chunks in cut if chunks is not None]
