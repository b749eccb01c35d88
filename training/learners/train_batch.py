"""Builds train batches from episode chunks: GAE advantages, value targets, sequences, shuffled minibatches.

RLlib's default learner pipeline handles each time step as a Python object. Here, the chunks of a policy are columns,
and their observations, T + 1 per chunk of T steps, are valued in a few passes. The last observation of a
chunk is the bootstrap: 0 if the agent terminated, its value if the agent was truncated or the chunk was cut.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from ray.rllib.core.columns import Columns
from torch import Tensor

from training.modules.actor_critic import ActorCritic
from training.sampling.episode_chunks import EpisodeChunks


def generalized_advantages(
    rewards: NDArray,
    values: NDArray,
    next_values: NDArray,
    lasts: NDArray,
    gamma: float,
    lambda_: float,
) -> NDArray:
    """Return the advantages of the steps of concatenated chunks.

        δ_t = r_t + γ V(s_{t+1}) − V(s_t)
        A_t = δ_t + γλ A_{t+1},    A_{t+1} = 0 after the last step of a chunk

    Schulman et al., 2016, "High-dimensional continuous control using generalized advantage estimation",
    arXiv 1506.02438, equations 11 and 16.

    Args:
        rewards: (n,).
        values: (n,), of the steps' observations.
        next_values: (n,), 0 where the agent terminated, and the value of the last observation where it was truncated or
            the chunk was cut.
        lasts: (n,) bool, True at the last step of each chunk.
        gamma: γ.
        lambda_: λ.

    Returns:
        (n,) float64.
    """
    assert rewards.shape == values.shape == next_values.shape == lasts.shape
    deltas = rewards.astype(np.float64) + gamma * next_values - values
    decays = np.where(lasts, 0.0, gamma * lambda_)
    advantages = np.empty_like(deltas)
    advantage = 0.0
    # Plain floats are faster than one NumPy call per time step of a padded matrix.
    steps = zip(range(len(deltas) - 1, -1, -1), deltas[::-1].tolist(), decays[::-1].tolist(), strict=True)
    for t, delta, decay in steps:
        advantage = delta + decay * advantage
        advantages[t] = advantage
    return advantages


Bootstraps = Callable[[EpisodeChunks], NDArray]
"""c chunks → (c,) bool: whether the value of each chunk's last observation counts."""

PASS_ROWS = 2048
"""Rows per forward pass over a batch: more than a few thousand images as floats would exhaust memory."""


@dataclass(frozen=True, slots=True)
class Sequences:
    """Consecutive steps for a recurrent policy. Sequence i is steps starts[i] to starts[i] + lengths[i] - 1.

    starts, lengths: (S,). state: key → (S, width), the initial recurrent states.
    """

    starts: Tensor
    lengths: Tensor
    state: dict[str, Tensor]


@dataclass(frozen=True, slots=True)
class TrainBatch:
    """n steps of one policy.

    observations: ONNX input name → (N, …) in the environment's dtype, N ≥ n; the steps' own are rows `acted`, (n,),
    which avoids copying images. actions: raw, (n,) or (n, m). dist_inputs: (n, d), of the sampling policy. log_p,
    advantages (standardised), targets (of the value function): (n,) float32.
    """

    observations: dict[str, Tensor]
    acted: Tensor
    actions: Tensor
    dist_inputs: Tensor
    log_p: Tensor
    advantages: Tensor
    targets: Tensor
    sequences: Sequences | None
    explained_variance: float
    """1 − Var(target − value) / Var(target) of the values before the update."""
    magnet: Tensor | None = None
    """Inputs of the action distribution of the magnet's reference policy, (n, d)."""
    taught: Tensor | None = None
    """Raw actions of the teacher, (n,) or (n, m)."""

    def __len__(self) -> int:
        return len(self.actions)

    @property
    def units(self) -> int:
        """The number of units that minibatches are drawn from: sequences if recurrent, otherwise steps."""
        return len(self) if self.sequences is None else len(self.sequences.starts)

    def take(self, units: Tensor) -> "Minibatch":
        """Return the steps of some units, in order."""
        if self.sequences is None:
            steps, memory = units, {}
        else:
            starts, lengths = self.sequences.starts[units], self.sequences.lengths[units]
            offsets = torch.arange(int(lengths.max()), device=starts.device)
            steps = (starts.unsqueeze(1) + offsets)[offsets < lengths.unsqueeze(1)]
            state = {key: value[units] for key, value in self.sequences.state.items()}
            memory = {Columns.SEQ_LENS: lengths, Columns.STATE_IN: state}
        rows = self.acted[steps]
        return Minibatch(
            inputs={Columns.OBS: {name: value[rows] for name, value in self.observations.items()}, **memory},
            actions=self.actions[steps],
            dist_inputs=self.dist_inputs[steps],
            log_p=self.log_p[steps],
            advantages=self.advantages[steps],
            targets=self.targets[steps],
            magnet=None if self.magnet is None else self.magnet[steps],
            taught=None if self.taught is None else self.taught[steps],
        )


@dataclass(frozen=True, slots=True)
class Minibatch:
    """Some steps of a TrainBatch. inputs: the arguments of the module's `forward_train`."""

    inputs: dict[str, Any]
    actions: Tensor
    dist_inputs: Tensor
    log_p: Tensor
    advantages: Tensor
    targets: Tensor
    magnet: Tensor | None = None
    taught: Tensor | None = None


def bootstrap_unless_terminated(chunks: EpisodeChunks) -> NDArray:
    """Bootstrap truncated and cut chunks: only terminal states have no future return."""
    return ~chunks.terminated


def train_batch(
    module: ActorCritic,
    samples: Sequence[EpisodeChunks],
    *,
    gamma: float,
    lambda_: float,
    sequence: int | None = None,
    bootstraps: Bootstraps = bootstrap_unless_terminated,
) -> TrainBatch:
    """Build a batch on the module's device, after updating its observation statistics.

    Args:
        module: The policy's module.
        samples: The policy's chunks, of one or more runners.
        gamma: Discount factor.
        lambda_: λ of the advantages.
        sequence: Maximum length of the sequences for a recurrent module.
        bootstraps: Selects the chunks whose last observation is bootstrapped from.
    """
    device = next(module.parameters()).device
    lengths = np.concatenate([chunks.lengths for chunks in samples])
    acted = np.delete(np.arange(lengths.sum() + len(lengths)), np.cumsum(lengths + 1) - 1)

    def column(values: NDArray) -> Tensor:
        return torch.from_numpy(values).to(device)

    observations = {
        name: column(np.concatenate([chunks.observations[name] for chunks in samples]))
        for name in samples[0].observations
    }
    module.encoder.update_statistics(observations)
    state = {key: column(np.concatenate([chunks.state[key] for chunks in samples])) for key in samples[0].state}
    values, bootstrap = _values(module, observations, acted, lengths, state)
    next_values = np.append(values[1:], 0.0)
    next_values[np.cumsum(lengths) - 1] = bootstrap * np.concatenate([bootstraps(chunks) for chunks in samples])
    rewards = np.concatenate([chunks.rewards for chunks in samples])
    lasts = np.zeros(len(acted), dtype=bool)
    lasts[np.cumsum(lengths) - 1] = True
    advantages = generalized_advantages(rewards, values, next_values, lasts, gamma, lambda_)
    targets = advantages + values
    sequences = None
    if sequence is not None and state:
        # Each chunk is split into sequences of this number of steps and a remainder.
        firsts = np.cumsum(lengths) - lengths
        starts = np.concatenate([first + np.arange(0, n, sequence) for first, n in zip(firsts, lengths, strict=True)])
        stops = np.append(starts[1:], lengths.sum())
        start_states = {key: value[starts] for key, value in state.items()}
        sequences = Sequences(column(starts), column(stops - starts), start_states)
    return TrainBatch(
        observations=observations,
        acted=column(acted),
        actions=column(np.concatenate([chunks.actions for chunks in samples])),
        dist_inputs=column(np.concatenate([chunks.dist_inputs for chunks in samples])),
        log_p=column(np.concatenate([chunks.log_p for chunks in samples])),
        advantages=column(((advantages - advantages.mean()) / max(1e-4, advantages.std())).astype(np.float32)),
        targets=column(targets.astype(np.float32)),
        sequences=sequences,
        explained_variance=float(1 - advantages.var() / max(targets.var(), 1e-8)),
    )


def _values(
    module: ActorCritic,
    observations: dict[str, Tensor],
    acted: NDArray,
    lengths: NDArray,
    state: dict[str, Tensor],
) -> tuple[NDArray, NDArray]:
    """Return the values of the steps' observations, (n,), and of each chunk's last observation, (c,)."""
    lasts, ends = np.cumsum(lengths) - 1, np.cumsum(lengths + 1) - 1
    if not state:
        values, _ = _value_pass(module, observations, np.arange(lengths.sum() + len(lengths)), {})
        return values[acted], values[ends]
    values, following = _value_pass(module, observations, acted, state)
    bootstrap, _ = _value_pass(module, observations, ends, {key: value[lasts] for key, value in following.items()})
    return values, bootstrap


@torch.no_grad()
def _value_pass(
    module: ActorCritic, observations: dict[str, Tensor], rows: NDArray, state: dict[str, Tensor]
) -> tuple[NDArray, dict[str, Tensor]]:
    """Return the values of some rows, one step each from its own recurrent state, and the states after it."""
    values, states = [], []
    for first in range(0, len(rows), PASS_ROWS):
        part = slice(first, first + PASS_ROWS)
        batch = {
            Columns.OBS: {name: value[rows[part]] for name, value in observations.items()},
            Columns.STATE_IN: {key: value[part] for key, value in state.items()},
        }
        value, after = module.value_step(batch)
        values.append(value.cpu().numpy())
        states.append(after)
    return np.concatenate(values), {key: torch.cat([after[key] for after in states]) for key in state}


def minibatches(batches: Mapping[str, TrainBatch], *, size: int, epochs: int) -> Iterator[dict[str, Minibatch]]:
    """Yield policy id → minibatch; each epoch visits each step of each policy once, in a new random order.

    All policies have the same number of minibatches, given by the policy with the most steps and `size`. RLlib's
    MiniBatchCyclicIterator uses equal sizes instead, which repeats the few steps of a small policy many times per
    epoch. For recurrent policies, whole sequences are drawn.
    """
    count = -(-max(len(batch) for batch in batches.values()) // size)
    for _ in range(epochs):
        orders = {policy: _order(batch).tensor_split(count) for policy, batch in batches.items()}
        for i in range(count):
            yield {policy: batches[policy].take(order[i]) for policy, order in orders.items() if len(order[i])}


def _order(batch: TrainBatch) -> torch.Tensor:
    # Drawn on the CPU, for the same order on every device.
    return torch.randperm(batch.units).to(batch.acted.device)
