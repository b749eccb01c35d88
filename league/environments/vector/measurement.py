"""Measures the speed of a vectorised environment with all of its copies in each call, as in training."""

from time import perf_counter

import numpy as np

from league.environments.vector.random_actions import legal_actions
from league.environments.vector.vector_env import VectorEnv
from league.spaces import Space


def steps_per_second(vector: VectorEnv, actions: list[Space], seed: int, seconds: float) -> float:
    """Return environment steps per second, all copies together, with random legal actions and resets.

    Drawing the actions is not counted.

    Args:
        vector: The environment.
        actions: Action space of each agent.
        seed: Seed of the actions and of the episodes' seeds.
        seconds: Duration of the measurement.
    """
    rng = np.random.default_rng(seed)
    copies = np.arange(vector.num_envs)
    steps, duration = 0, 0.0
    rows = list(vector.reset(copies, rng.integers(2**31, size=len(copies))))
    while duration < seconds:
        drawn = legal_actions(rows, actions, rng)
        began = perf_counter()
        rows = list(vector.step(copies, drawn))
        over = np.ones(len(copies), dtype=bool)
        for block in rows:
            over[block.envs[~block.has_ended]] = False
        if len(ended := np.flatnonzero(over)):
            rows += vector.reset(ended, rng.integers(2**31, size=len(ended)))
        duration += perf_counter() - began
        steps += len(copies)
    return steps / duration
