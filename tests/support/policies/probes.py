"""Probes of the graphs of `tests.support.policies.graphs`."""

import numpy as np

from league.policies.onnx import OnnxPolicy
from league.policies.probes import Probes
from tests.support.policies.graphs import masked_mlp


def probes(seed: int = 0, rows: int = 16) -> Probes:
    """The actions of masked_mlp(seed) on random boards."""
    random = np.random.default_rng(0)
    observations = {
        "observation": random.integers(0, 2, (rows, 6, 7, 2), dtype=np.int8),
        "action_mask": np.ones((rows, 7), np.int8),
    }
    return Probes(observations, {}, OnnxPolicy(masked_mlp(seed=seed)).act(observations).actions)
