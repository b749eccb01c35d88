"""Rows of play → chunks of episodes, one agent's steps each, as RLlib's SingleAgentEpisode.

An agent's transition is open from its action until its own next row or its ending; the reward that arrives there is
the sum of all that happened between. What is still open when a sample is cut is carried over to the next one, where the
chunk goes on from the same row: no step is lost, none is counted twice, and the bootstrap value of a cut chunk belongs
to an observation that the agent really had.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from ray.rllib.core.columns import Columns
from ray.rllib.env.single_agent_episode import SingleAgentEpisode
from ray.rllib.env.utils.infinite_lookback_buffer import InfiniteLookbackBuffer

from league.environments.stepping import Ending

Rows = dict[str, NDArray]
"""Column → its rows, (k, …)."""

NO_INFO: dict[str, object] = {}
STATE = f"{Columns.STATE_IN}/"
"""Begins the names of a memory's columns."""
NO_ROW = -1


class Chunk(SingleAgentEpisode):
    """Some steps of one agent in one episode, with the observation after the last of them."""

    __slots__ = ()

    def validate(self) -> None:
        """RLlib compares the lengths of all columns, which takes longer than all else. Here one slice cuts them all."""


class Column(InfiniteLookbackBuffer):
    """A column of a chunk. Chunks have no spaces, and RLlib takes the absent one apart anew for each column."""

    @property
    def space(self) -> Any:
        return self._space

    @space.setter
    def space(self, value: Any) -> None:
        if value is None:
            self._space = self._space_struct = None
        else:
            InfiniteLookbackBuffer.space.fset(self, value)


@dataclass(frozen=True, slots=True)
class End:
    """An agent's part in an episode ends behind `after` rows: by its ending, or None where the episode is lost."""

    after: int
    slot: int
    ending: Ending | None


@dataclass(frozen=True, slots=True)
class Layout:
    """The rows and endings of a sample, those of one slot side by side in their order, and where chunks begin and end.

    rows: where their observations are. rewards: that came with them. Of each of c chunks: firsts, lasts, the places of
    its first and last row; slots; started, the steps of its episode before it; ends, what ended it or None.
    """

    rows: NDArray
    rewards: NDArray
    firsts: NDArray
    lasts: NDArray
    slots: NDArray
    started: NDArray
    ends: list[End | None]

    @property
    def steps(self) -> NDArray:
        """(c,) of each chunk."""
        return self.lasts - self.firsts


class Transitions:
    """The play of one policy, in all copies. A slot is an agent of a copy: copy · agents + agent.

    Call in turn: `end` and `lose` for what has ended, `observe` with the rows that must act, `act` with what was done;
    `cut` at any point between `observe` and `act`.
    """

    def __init__(self, policy: str, agents: Sequence[str], copies: int) -> None:
        self._policy = policy
        self._agents = tuple(agents)
        self._started = np.zeros(copies * len(agents), dtype=np.int64)
        self._slots: list[NDArray] = []
        self._rewards: list[NDArray] = []
        self._observations: list[Rows] = []
        self._plays: list[Rows] = []
        self._ends: list[End] = []
        self._observed = 0

    def observe(self, slots: NDArray, rewards: NDArray, observations: Rows) -> None:
        """Take the next rows, (k,) each and ONNX input name → (k, …): they close what their agents had open."""
        self._slots.append(slots)
        self._rewards.append(rewards)
        self._observations.append(observations)
        self._observed += len(slots)

    def act(self, raw: NDArray, log_p: NDArray, dist_inputs: NDArray, state: Mapping[str, NDArray] | None) -> None:
        """Record what was done on the rows of the last `observe`: raw actions (k,) or (k, m), (k,) and (k, d), and of
        a policy with a memory the states before, key → (k, width)."""
        play = {Columns.ACTIONS: raw, Columns.ACTION_LOGP: log_p, Columns.ACTION_DIST_INPUTS: dist_inputs}
        self._plays.append(play | {STATE + key: value for key, value in (state or {}).items()})

    def end(self, slot: int, ending: Ending) -> None:
        """An agent has left, whoever played it."""
        self._ends.append(End(self._observed, slot, ending))

    def lose(self, copy: int) -> None:
        """The episode in `copy` will have no end: forget what was observed of it since the last cut."""
        first = copy * len(self._agents)
        self._ends += [End(self._observed, slot, None) for slot in range(first, first + len(self._agents))]

    def cut(self, ids: Iterator[str]) -> list[SingleAgentEpisode]:
        """All transitions that were closed since the last cut, as chunks. Each takes an id of its own from `ids`."""
        if not self._observed:
            self._ends = []
            return []
        layout = self._laid_out()
        finals = [end.ending.observation for end in self._ends if end.ending]
        observations, played = _stacked(self._observations, finals), _stacked(self._plays)
        chunks = list(self._chunks(layout, observations, played, ids))
        self._carry_over(layout, observations, played)
        return chunks

    def _laid_out(self) -> Layout:
        ends, observed = self._ends, self._observed
        after = [end.after for end in ends]
        # The observations of endings are stacked behind those of all rows.
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
        # What was carried over is the first of its slot; later chunks of the slot belong to later episodes.
        is_first_of_slot = np.append(True, is_other_slot)[firsts]
        return Layout(
            rows,
            rewards,
            firsts,
            lasts,
            slots[firsts],
            np.where(is_first_of_slot, self._started[slots[firsts]], 0),
            [ends[i] if i < len(ends) else None for i in which[lasts].tolist()],
        )

    def _chunks(self, layout: Layout, observations: Rows, played: Rows, ids: Iterator[str]) -> Iterator[Chunk]:
        """One gather per column puts each chunk's rows side by side; the chunks hold views of it."""
        are_whole = np.array([end is None or end.ending is not None for end in layout.ends], dtype=bool)
        steps = layout.steps
        # An ending alone is that of an agent that this policy did not play.
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
            # Each chunk before has one observation more than it has steps.
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
    ) -> Chunk:
        state = {name.removeprefix(STATE): played.pop(name) for name in list(played) if name.startswith(STATE)}
        columns: dict[str, NDArray | Rows] = {**played, **({Columns.STATE_IN: state} if state else {})}
        buffers = {name: Column(column) for name, column in columns.items()}
        return Chunk(
            id_=id_,
            agent_id=agent,
            module_id=self._policy,
            # RLlib tells the chunks of a batch apart by this id alone, and misaligns advantages if it repeats.
            multi_agent_episode_id=id_,
            t_started=started,
            len_lookback_buffer=0,
            observations=Column(observations),
            infos=Column([NO_INFO] * (len(rewards) + 1)),
            actions=buffers.pop(Columns.ACTIONS),
            rewards=Column(rewards),
            extra_model_outputs=buffers,
            terminated=ending is not None and ending.terminated,
            truncated=ending is not None and ending.truncated and not ending.terminated,
        )

    def _carry_over(self, layout: Layout, observations: Rows, played: Rows) -> None:
        """Begin the next sample with the row that each open chunk ended on: those that have acted come first, since
        those that must act next are the last that were observed."""
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


def _stacked(blocks: Sequence[Rows], rows: Sequence[Rows] = ()) -> Rows:
    """Blocks (k_i, …), then single rows (…), under one another; no columns without any block."""
    if not blocks:
        return {}
    return {
        name: np.concatenate([block[name] for block in blocks] + [row[name][np.newaxis] for row in rows])
        for name in blocks[0]
    }
