"""The ablation of `benchmarks.learning`: the last observation of a truncated agent has no value, as in RLlib."""

from numpy.typing import NDArray
from ray.rllib.algorithms.algorithm import Algorithm

from training.sampling.episode_chunks import EpisodeChunks


def as_rllib(algorithm: Algorithm) -> None:
    """RLlib 2.60 flags agents that are truncated together as terminated (`multi_agent_episode.py`): the learner of this
    process then bootstraps only where a chunk was cut.
    """
    algorithm.learner_group._learner.bootstraps = unless_done


def unless_done(chunks: EpisodeChunks) -> NDArray:
    """Whether the episode of each chunk continues."""
    return ~(chunks.terminated | chunks.truncated)
