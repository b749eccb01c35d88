"""Rows of play → chunks of episodes, one agent's steps each, as RLlib's SingleAgentEpisode.

An agent's transition is open from its action until its own next row or its ending; the reward that arrives there is
the sum of all that happened between. What is still open when a sample is cut is carried over to the next one, where the
chunk goes on from the same row: no step is lost, none is counted twice, and the bootstrap value of a cut chunk belongs
to an observation that the agent really had.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from ray.rllib.core.columns import Columns
from ray.rllib.env.single_agent_episode import SingleAgentEpisode
from ray.rllib.env.utils.infinite_lookback_buffer import InfiniteLookbackBuffer

from league.environments.stepping import Batch, Ending

NO_INFO: dict[str, object] = {}


@dataclass(slots=True)
class Chunk:
    """One agent's steps since the last cut. rewards[i] belongs to rows[i]; the last row has none yet."""

    agent: int
    rows: list[int] = field(default_factory=list)
    rewards: list[float] = field(default_factory=list)
    steps_before: int = 0
    return_before: float = 0.0


@dataclass(frozen=True, slots=True)
class AgentEpisode:
    """What an agent had from an episode that is over."""

    agent: int
    steps: int
    return_: float


class Transitions:
    """The play of one policy, in all copies.

    Call in turn: `end` for each ending of its agents, `observe` with the batch of rows that must act, `act` with what
    was done; `cut` at any point between `observe` and `act`.
    """

    def __init__(self, policy: str, agents: tuple[str, ...]) -> None:
        self._policy = policy
        self._agents = agents
        self._open: dict[tuple[int, int], Chunk] = {}
        self._closed: list[tuple[Chunk, Ending]] = []
        self._observations: list[dict[str, NDArray]] = []
        self._plays: list[tuple[NDArray, NDArray, NDArray]] = []
        self._observed = 0

    def observe(self, batch: Batch) -> None:
        """Take the next rows: they close the transitions that their agents had open."""
        row = self._observed
        chunks = self._open
        for copy, agent, reward in zip(batch.copies, batch.agents, batch.rewards, strict=True):
            chunk = chunks.get((copy, agent))
            if chunk is None:
                # What others' moves brought before the agent's first turn belongs to no action of its own.
                chunk = chunks[copy, agent] = Chunk(agent, return_before=reward)
            else:
                chunk.rewards.append(reward)
            chunk.rows.append(row)
            row += 1
        self._observed = row
        self._observations.append(batch.observations)

    def act(self, actions: NDArray, log_probabilities: NDArray, dist_inputs: NDArray) -> None:
        """Record what was done on the rows of the last `observe`: (k,), (k,) and (k, d)."""
        self._plays.append((actions, log_probabilities, dist_inputs))

    def end(self, ending: Ending) -> AgentEpisode:
        """Close the transition of an agent that has left."""
        chunk = self._open.pop((ending.copy, ending.agent), None)
        if chunk is None:
            return AgentEpisode(ending.agent, 0, ending.reward)
        chunk.rewards.append(ending.reward)
        self._closed.append((chunk, ending))
        return AgentEpisode(
            ending.agent,
            chunk.steps_before + len(chunk.rewards),
            chunk.return_before + sum(chunk.rewards),
        )

    @property
    def has_closed(self) -> bool:
        """Whether a transition was closed since the last cut."""
        return bool(self._closed) or any(chunk.rewards for chunk in self._open.values())

    def cut(self, ids: Iterator[str]) -> list[SingleAgentEpisode]:
        """All transitions that were closed since the last cut, as chunks. Each takes an id of its own from `ids`."""
        if not self._observations:
            return []
        actions, log_probabilities, dist_inputs = (np.concatenate(column) for column in self._played())
        finals = [ending.observation for _, ending in self._closed]
        observations = _stack(self._observations, finals)
        chunks: list[tuple[Chunk, list[int], Ending | None]] = [
            (chunk, [*chunk.rows, self._observed + i], ending) for i, (chunk, ending) in enumerate(self._closed)
        ]
        chunks += [(chunk, chunk.rows, None) for chunk in self._open.values() if chunk.rewards]
        episodes = list(self._episodes(chunks, observations, actions, log_probabilities, dist_inputs, ids))
        self._carry_over(observations, actions, log_probabilities, dist_inputs)
        return episodes

    def _played(self) -> Iterator[list[NDArray]]:
        if self._plays:
            yield from map(list, zip(*self._plays, strict=True))
        else:
            yield from ([np.zeros(0, np.int64)], [np.zeros(0, np.float32)], [np.zeros((0, 1), np.float32)])

    def _episodes(
        self,
        chunks: list[tuple[Chunk, list[int], Ending | None]],
        observations: dict[str, NDArray],
        actions: NDArray,
        log_probabilities: NDArray,
        dist_inputs: NDArray,
        ids: Iterator[str],
    ) -> Iterator[SingleAgentEpisode]:
        """One gather per column puts each chunk's rows side by side; the episodes hold views of it."""
        seen = np.array([row for _, rows, _ in chunks for row in rows], dtype=np.intp)
        done = np.array([row for chunk, _, _ in chunks for row in chunk.rows[: len(chunk.rewards)]], dtype=np.intp)
        observations = {name: array[seen] for name, array in observations.items()}
        actions, log_probabilities, dist_inputs = actions[done], log_probabilities[done], dist_inputs[done]
        rewards = np.array([reward for chunk, _, _ in chunks for reward in chunk.rewards], dtype=np.float32)
        start = first = 0
        for chunk, rows, ending in chunks:
            stop, last = start + len(chunk.rewards), first + len(rows)
            id_ = next(ids)
            yield SingleAgentEpisode(
                id_=id_,
                agent_id=self._agents[chunk.agent],
                module_id=self._policy,
                # RLlib tells the chunks of a batch apart by this id alone, and misaligns advantages if it repeats.
                multi_agent_episode_id=id_,
                t_started=chunk.steps_before,
                len_lookback_buffer=0,
                observations=InfiniteLookbackBuffer({name: a[first:last] for name, a in observations.items()}),
                infos=InfiniteLookbackBuffer([NO_INFO] * len(rows)),
                actions=InfiniteLookbackBuffer(actions[start:stop]),
                rewards=InfiniteLookbackBuffer(rewards[start:stop]),
                extra_model_outputs={
                    Columns.ACTION_LOGP: InfiniteLookbackBuffer(log_probabilities[start:stop]),
                    Columns.ACTION_DIST_INPUTS: InfiniteLookbackBuffer(dist_inputs[start:stop]),
                },
                terminated=ending is not None and ending.terminated,
                truncated=ending is not None and ending.truncated and not ending.terminated,
            )
            start, first = stop, last

    def _carry_over(
        self,
        observations: dict[str, NDArray],
        actions: NDArray,
        log_probabilities: NDArray,
        dist_inputs: NDArray,
    ) -> None:
        """Begin the next sample with the row that each open chunk ended on: first those that have acted, in any order,
        then those that must act next, in the order of their batch."""
        acted = [chunk.rows[-1] for chunk in self._open.values() if chunk.rows[-1] < len(actions)]
        kept = acted + list(range(len(actions), self._observed))
        position = {row: i for i, row in enumerate(kept)}
        for chunk in self._open.values():
            chunk.rows = [position[chunk.rows[-1]]]
            chunk.steps_before += len(chunk.rewards)
            chunk.return_before += sum(chunk.rewards)
            chunk.rewards = []
        self._closed = []
        self._observations = [{name: array[kept] for name, array in observations.items()}]
        self._observed = len(kept)
        self._plays = [(actions[acted], log_probabilities[acted], dist_inputs[acted])] if acted else []


def _stack(blocks: list[dict[str, NDArray]], rows: list[dict[str, NDArray]]) -> dict[str, NDArray]:
    """Blocks (k_i, …), then single rows (…), under one another."""
    return {
        name: np.concatenate([block[name] for block in blocks] + [row[name][np.newaxis] for row in rows])
        for name in blocks[0]
    }
