"""Generalised advantage estimation."""

import numpy as np
from numpy.typing import NDArray


def generalized_advantages(
    rewards: NDArray,
    values: NDArray,
    next_values: NDArray,
    lasts: NDArray,
    gamma: float,
    lambda_: float,
) -> NDArray:
    """Advantages of the steps of chunks that stand one behind another.

        δ_t = r_t + γ V(s_{t+1}) − V(s_t)
        A_t = δ_t + γλ A_{t+1},    A_{t+1} = 0 behind the last step of a chunk

    Schulman et al., 2016, "High-dimensional continuous control using generalized advantage estimation",
    arXiv 1506.02438, equations 11 and 16. next_values is 0 where the agent terminated, and the value of the
    last observation where it was truncated or the chunk was cut.

    All arrays (n,); `lasts` is True at the last step of each chunk. Returns (n,) float64.
    """
    assert rewards.shape == values.shape == next_values.shape == lasts.shape
    deltas = rewards.astype(np.float64) + gamma * next_values - values
    decays = np.where(lasts, 0.0, gamma * lambda_)
    advantages = np.empty_like(deltas)
    advantage = 0.0
    # Plain floats: a step of the recursion costs less so than one NumPy call per time step of a padded matrix.
    steps = zip(range(len(deltas) - 1, -1, -1), deltas[::-1].tolist(), decays[::-1].tolist(), strict=True)
    for t, delta, decay in steps:
        advantage = delta + decay * advantage
        advantages[t] = advantage
    return advantages
