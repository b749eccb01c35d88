"""Limits how often an environment may crash before its error is raised."""

import logging

import numpy as np

from league.environments.stepping import Indices
from league.errors import one_line

logger = logging.getLogger(__name__)


class CrashLimit:
    """Counts the consecutive crashes of each environment."""

    def __init__(self, num_envs: int, most: int) -> None:
        """most: number of consecutive crashes after which an environment is recreated; the next one is raised."""
        self._most = most
        self._consecutive = np.zeros(num_envs, np.int64)

    def count(self, env: int, seed: int, error: Exception) -> None:
        """Count a crash in the episode with that seed, and log it.

        Raises `error` if it is one too many, with a note that names the seed.
        """
        self._consecutive[env] += 1
        if self._consecutive[env] > self._most:
            error.add_note(f"in the episode with seed {seed}")
            raise error
        logger.warning(
            "The environment raised in the episode with seed %d and is recreated (%d of %d consecutive times): %s",
            seed,
            self._consecutive[env],
            self._most,
            one_line(error, with_type=True),
        )

    def finish(self, envs: Indices) -> None:
        """Start counting anew: these environments have finished an episode."""
        self._consecutive[envs] = 0
