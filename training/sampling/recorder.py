"""Records sampled steps as episode chunks for RLlib's learners.

An agent's transition is open from its action until its own next row or its end; its reward is the sum of all rewards in
between. Transitions that are open when a sample is cut are carried over to the next sample, whose chunk starts at the
same row: no step is lost or counted twice, and a cut chunk is bootstrapped from an observation that the agent received.
"""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from ray.rllib.core.columns import Columns
from ray.rllib.env.single_agent_episode import SingleAgentEpisode

from league.environments.stepping import Ending, Turn
from league.interface import Interface
from training.rllib_compat import ChunkColumn, EpisodeChunk
from training.sampling.reset_seeds import ResetSeeds

Rows = dict[str, NDArray]
"""Column → its rows, (k, …)."""

NO_INFO: dict[str, object] = {}
STATE_PREFIX = f"{Columns.STATE_IN}/"
"""Prefix of the columns of recurrent states."""
NO_ROW = -1


@dataclass(frozen=True, slots=True)
class EpisodeEnd:
    """Ends an agent's part of an episode after `after` rows. ending: None if the episode is lost."""

    after: int
    slot: int
    ending: Ending | None


@dataclass(frozen=True, slots=True)
class ChunkLayout:
    """The rows and endings of a sample sorted by slot, and the boundaries of chunks.

    rows: indices of the observations. rewards: received with them. For each of c chunks: firsts and lasts, the
    positions of its first and last row; slots; started, steps of its episode before the chunk; ends, what ended it, or
    None.
    """

    rows: NDArray
    rewards: NDArray
    firsts: NDArray
    lasts: NDArray
    slots: NDArray
    started: NDArray
    ends: list[EpisodeEnd | None]

    @property
    def steps(self) -> NDArray:
        """The number of steps of each chunk, (c,)."""
        return self.lasts - self.firsts


class ChunkBuilder:
    """Builds the chunks of one policy in all environments. A slot is an agent of an environment: env · agents + agent.

    Order of calls: `end` and `discard` for what has ended, `observe` with the rows that must act, `act` with the
    actions; `cut` anywhere between `observe` and `act`.
    """

    def __init__(self, policy: str, agents: Sequence[str], num_envs: int) -> None:
        self._policy = policy
        self._agents = tuple(agents)
        self._started = np.zeros(num_envs * len(agents), dtype=np.int64)
        self._slots: list[NDArray] = []
        self._rewards: list[NDArray] = []
        self._observations: list[Rows] = []
        self._plays: list[Rows] = []
        self._ends: list[EpisodeEnd] = []
        self._observed = 0

    def observe(self, slots: NDArray, rewards: NDArray, observations: Rows) -> None:
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
        play = {Columns.ACTIONS: raw, Columns.ACTION_LOGP: log_p, Columns.ACTION_DIST_INPUTS: dist_inputs}
        self._plays.append(play | {STATE_PREFIX + key: value for key, value in (state or {}).items()})

    def end(self, slot: int, ending: Ending) -> None:
        """Add that an agent has left its episode, whoever controlled it."""
        self._ends.append(EpisodeEnd(self._observed, slot, ending))

    def discard(self, env: int) -> None:
        """Drop what was observed of the current episode of `env` since the last cut: it has no end."""
        first = env * len(self._agents)
        self._ends += [EpisodeEnd(self._observed, slot, None) for slot in range(first, first + len(self._agents))]

    def cut(self, ids: Iterator[str]) -> list[SingleAgentEpisode]:
        """Return all transitions closed since the last cut as chunks. Each takes its id from `ids`."""
        if not self._observed:
            self._ends = []
            return []
        layout = self._layout()
        finals = [end.ending.observation for end in self._ends if end.ending]
        observations, played = _stack(self._observations, finals), _stack(self._plays)
        chunks = list(self._chunks(layout, observations, played, ids))
        self._carry_over(layout, observations, played)
        return chunks

    def _layout(self) -> ChunkLayout:
        ends, observed = self._ends, self._observed
        after = [end.after for end in ends]
        # The observations of endings follow those of all rows.
        are_lost = np.array([end.ending is None for end in ends], dtype=bool)
        numbers = np.where(are_lost, NO_ROW, observed - 1 + np.cumsum(~are_lost))
        rows = np.insert(np.arange(observed), after, numbers)
        slots = np.insert(np.concatenate(self._slots), after, [end.slot for end in ends])
        gained = [end.ending.reward if end.ending else 0.0 for end in ends]
        rewards = np.insert(np.concatenate(self._rewards), after, gained)
        which = np.insert(np.full(observed, len(ends)), after, np.arange(len(ends)))
        order = np.argsort(slots, kind="stable")
        rows, slots, rewards, which = rows[order], slots[order], rewards[order], which[order]
        is_other_slot = np.diff(slots) != 0
        lasts = np.flatnonzero(np.append((which[:-1] < len(ends)) | is_other_slot, True))
        firsts = np.append(0, lasts[:-1] + 1)
        # A chunk that was carried over is the first of its slot; later chunks of the slot are new episodes.
        is_first_of_slot = np.append(True, is_other_slot)[firsts]
        return ChunkLayout(
            rows,
            rewards,
            firsts,
            lasts,
            slots[firsts],
            np.where(is_first_of_slot, self._started[slots[firsts]], 0),
            [ends[i] if i < len(ends) else None for i in which[lasts].tolist()],
        )

    def _chunks(
        self, layout: ChunkLayout, observations: Rows, played: Rows, ids: Iterator[str]
    ) -> Iterator[EpisodeChunk]:
        """Gather each column once, so that each chunk's rows are adjacent; chunks hold views of it."""
        are_whole = np.array([end is None or end.ending is not None for end in layout.ends], dtype=bool)
        steps = layout.steps
        # An ending without steps is that of an agent which this policy did not control.
        are_whole &= steps > 0
        if not are_whole.any():
            return
        is_seen = np.repeat(are_whole, steps + 1)
        is_acted, is_rewarded = is_seen.copy(), is_seen.copy()
        is_acted[layout.lasts] = is_rewarded[layout.firsts] = False
        observations = {name: array[layout.rows[is_seen]] for name, array in observations.items()}
        played = {name: column[layout.rows[is_acted]] for name, column in played.items()}
        rewards = layout.rewards[is_rewarded].astype(np.float32)
        start = 0
        for number, place in enumerate(np.flatnonzero(are_whole).tolist()):
            stop = start + int(steps[place])
            # Each earlier chunk has one observation more than steps.
            seen = slice(start + number, stop + number + 1)
            end = layout.ends[place]
            yield self._chunk(
                next(ids),
                self._agents[int(layout.slots[place]) % len(self._agents)],
                int(layout.started[place]),
                {name: array[seen] for name, array in observations.items()},
                {name: column[start:stop] for name, column in played.items()},
                rewards[start:stop],
                end.ending if end else None,
            )
            start = stop

    def _chunk(
        self,
        id_: str,
        agent: str,
        started: int,
        observations: Rows,
        played: Rows,
        rewards: NDArray,
        ending: Ending | None,
    ) -> EpisodeChunk:
        state = {
            name.removeprefix(STATE_PREFIX): played.pop(name) for name in list(played) if name.startswith(STATE_PREFIX)
        }
        columns: dict[str, NDArray | Rows] = {**played, **({Columns.STATE_IN: state} if state else {})}
        buffers = {name: ChunkColumn(column) for name, column in columns.items()}
        return EpisodeChunk(
            id_=id_,
            agent_id=agent,
            module_id=self._policy,
            # RLlib distinguishes the chunks of a batch by this id only, and misaligns advantages if it repeats.
            multi_agent_episode_id=id_,
            t_started=started,
            len_lookback_buffer=0,
            observations=ChunkColumn(observations),
            infos=ChunkColumn([NO_INFO] * (len(rewards) + 1)),
            actions=buffers.pop(Columns.ACTIONS),
            rewards=ChunkColumn(rewards),
            extra_model_outputs=buffers,
            terminated=ending is not None and ending.terminated,
            truncated=ending is not None and ending.truncated and not ending.terminated,
        )

    def _carry_over(self, layout: ChunkLayout, observations: Rows, played: Rows) -> None:
        """Start the next sample with the last row of each open chunk.

        Rows with actions come first, since the rows that must act next were observed last.
        """
        are_open = np.array([end is None for end in layout.ends], dtype=bool)
        self._started[:] = 0
        self._started[layout.slots[are_open]] = (layout.started + layout.steps)[are_open]
        kept = np.sort(layout.rows[layout.lasts[are_open]])
        acted = kept[kept < (len(played[Columns.ACTIONS]) if played else 0)]
        self._slots = [np.concatenate(self._slots)[kept]]
        self._rewards = [np.concatenate(self._rewards)[kept]]
        self._observations = [{name: array[kept] for name, array in observations.items()}]
        self._plays = [{name: column[acted] for name, column in played.items()}] if len(acted) else []
        self._ends = []
        self._observed = len(kept)


def _stack(blocks: Sequence[Rows], rows: Sequence[Rows] = ()) -> Rows:
    """Concatenate blocks (k_i, …) and single rows (…); no columns without blocks."""
    if not blocks:
        return {}
    return {
        name: np.concatenate([block[name] for block in blocks] + [row[name][np.newaxis] for row in rows])
        for name in blocks[0]
    }


class Recorder(Protocol):
    """Receives each turn, then the actions of the league's own policies in it.

    Groups of a turn that are not policy ids are controlled by others, and are not recorded.
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

    def __init__(self, interface: Interface, agents: Sequence[str], num_envs: int) -> None:
        self._agents, self._num_envs = tuple(agents), num_envs
        self._policies = tuple(interface.policies[agent] for agent in agents)
        self._learning = interface.policy_ids
        self._ids: Iterator[str] = iter(())

    def begin(self, seeds: ResetSeeds) -> None:
        self._ids = (f"{seeds.runner}-{seeds.steps}-{i}" for i in itertools.count())

    def restart(self) -> None:
        self._transitions = {policy: ChunkBuilder(policy, self._agents, self._num_envs) for policy in self._learning}

    def read(self, turn: Turn) -> None:
        for env in turn.crashed:
            for transitions in self._transitions.values():
                transitions.discard(env)
        for ending in turn.endings:
            slot = ending.env * len(self._agents) + ending.agent
            self._transitions[self._policies[ending.agent]].end(slot, ending)
        for group, batch in turn.batches.items():
            if isinstance(group, str):
                slots = np.array(batch.envs) * len(self._agents) + np.array(batch.agents)
                rewards = np.array(batch.rewards, dtype=np.float64)
                self._transitions[group].observe(slots, rewards, batch.observations)

    def act(
        self, policy: str, raw: NDArray, log_p: NDArray, dist_inputs: NDArray, state: Mapping[str, NDArray] | None
    ) -> None:
        self._transitions[policy].act(raw, log_p, dist_inputs, state)

    def cut(self) -> list[SingleAgentEpisode]:
        """Return the transitions closed since the last cut."""
        return [chunk for transitions in self._transitions.values() for chunk in transitions.cut(self._ids)]
