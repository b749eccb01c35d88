"""Episodes with given seeds and groups, for tests of stepping."""

from collections.abc import Iterable, Sequence
from itertools import islice

import numpy as np

from league.environments.stepping import NextEpisodes, Starts


def episodes(seeds: Iterable[int], groups: Sequence[int]) -> NextEpisodes:
    """Episodes with these seeds, in order; all have the same groups."""
    coming = iter(seeds)

    def next_episodes(envs: np.ndarray) -> Starts:
        batch_of_episodes = list(islice(coming, len(envs)))
        return Starts(
            envs[: len(batch_of_episodes)],
            np.array(batch_of_episodes, np.int64),
            np.tile(groups, (len(batch_of_episodes), 1)),
        )

    return next_episodes
