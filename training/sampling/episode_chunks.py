"""Sampled steps of one policy in columns, and their conversion to RLlib's episodes."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from ray.rllib.core.columns import Columns
from ray.rllib.env.single_agent_episode import SingleAgentEpisode

from league.environments.stepping import Indices
from training.rllib_compat import ChunkColumn, EpisodeChunk

NO_INFO: dict[str, object] = {}
PASS_ROWS = 2048
"""Rows per forward pass over a sample: more than a few thousand images as floats would exhaust memory."""


@dataclass(frozen=True, slots=True)
class EpisodeChunks:
    """c chunks with n steps in total. A chunk is consecutive steps of one agent in one episode.

    The rows of a chunk are adjacent, in the order of its steps.

    Attributes:
        name: Unique among all chunks of a run.
        policy: Policy id.
        agents: Index of the agent of each chunk, (c,).
        started: Steps of the agent's policy in the episode before each chunk, (c,).
        lengths: Steps of each chunk, (c,), at least 1.
        observations: ONNX input name → (n + c, …). Each chunk has one observation more than steps.
        actions: Raw, (n,) or (n, m).
        log_p: (n,).
        dist_inputs: (n, d).
        state: Key → (n, width), the recurrent state before each step; empty if not recurrent.
        rewards: (n,) float32.
        terminated: (c,) bool.
        truncated: (c,) bool; never both. A chunk with neither flag was cut.
        taught: The teacher's raw actions, as `actions`; None if it did not act.
        central: What a central critic gets besides the observations, column → (n + c, …).
    """

    name: str
    policy: str
    agents: Indices
    started: Indices
    lengths: Indices
    observations: Mapping[str, NDArray]
    actions: NDArray
    log_p: NDArray
    dist_inputs: NDArray
    state: Mapping[str, NDArray]
    rewards: NDArray[np.float32]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    taught: NDArray[np.int64] | None = None
    central: Mapping[str, NDArray] = field(default_factory=dict)


def acted_rows(lengths: Indices) -> Indices:
    """Return the rows of the steps among the observations of consecutive chunks, (n,): all but each chunk's last.

    lengths: see EpisodeChunks.
    """
    return np.delete(np.arange(lengths.sum() + len(lengths)), np.cumsum(lengths + 1) - 1)


def as_episodes(chunks: EpisodeChunks, agents: Sequence[str]) -> Iterator[SingleAgentEpisode]:
    """Yield the chunks as RLlib's episodes, whose columns are views. agents: names of all agents."""
    stops = np.cumsum(chunks.lengths).tolist()
    for number, (stop, length) in enumerate(zip(stops, chunks.lengths.tolist(), strict=True)):
        steps = slice(stop - length, stop)
        # Each earlier chunk has one observation more than steps.
        observation_rows = slice(stop - length + number, stop + number + 1)
        outputs = {
            Columns.ACTION_LOGP: ChunkColumn(chunks.log_p[steps]),
            Columns.ACTION_DIST_INPUTS: ChunkColumn(chunks.dist_inputs[steps]),
        }
        if chunks.state:
            outputs[Columns.STATE_IN] = ChunkColumn({key: column[steps] for key, column in chunks.state.items()})
        id_ = f"{chunks.name}-{number}"
        yield EpisodeChunk(
            id_=id_,
            agent_id=agents[chunks.agents[number]],
            module_id=chunks.policy,
            # RLlib distinguishes the chunks of a batch by this id only, and misaligns advantages if it repeats.
            multi_agent_episode_id=id_,
            t_started=int(chunks.started[number]),
            len_lookback_buffer=0,
            observations=ChunkColumn({name: array[observation_rows] for name, array in chunks.observations.items()}),
            infos=ChunkColumn([NO_INFO] * (length + 1)),
            actions=ChunkColumn(chunks.actions[steps]),
            rewards=ChunkColumn(chunks.rewards[steps]),
            extra_model_outputs=outputs,
            terminated=bool(chunks.terminated[number]),
            truncated=bool(chunks.truncated[number]),
        )
