"""Episodes with given seeds and groups, for tests of stepping."""

from collections.abc import Iterable, Sequence
from itertools import islice

import numpy as np

from league.environments.stepping import NextEpisodes, Starts


def episodes(seeds: Iterable[int], groups: Sequence[int]) -> NextEpisodes:
    """Episodes with these seeds, in order; all have the same groups."""
    coming = iter(seeds)

    def next_episodes(envs: np.ndarray) -> Starts:
        taken = list(islice(coming, len(envs)))
        return Starts(envs[: len(taken)], np.array(taken, np.int64), np.tile(groups, (len(taken), 1)))

    return next_episodes
