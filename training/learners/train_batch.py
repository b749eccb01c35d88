"""Builds train batches from episode chunks: GAE advantages, value targets, sequences, shuffled minibatches.

RLlib's default learner pipeline handles each time step as a Python object. Here, the chunks of a policy are columns,
and their observations, T + 1 per chunk of T steps, are valued in a few passes. The last observation of a
chunk is the bootstrap: 0 if the agent terminated, its value if the agent was truncated or the chunk was cut.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import zip_longest
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from ray.rllib.core.columns import Columns
from torch import Tensor

from training.learners.ranks import ALONE, Rank
from training.modules.actor_critic import ActorCritic
from training.modules.value_function import CentralCritic, ReturnNormalization
from training.sampling.episode_chunks import PASS_ROWS, EpisodeChunks, acted_rows

GPU_PASS_ROWS = 4 * PASS_ROWS
"""Rows per forward pass on a GPU, where a pass of fewer rows takes as long."""


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
    advantages = rewards.astype(np.float64) + gamma * next_values - values
    decays, steps = np.where(lasts, 0.0, gamma * lambda_), 1
    # Each advantage is the sum over `steps` steps, which doubles (Hillis and Steele, 1986, "Data parallel algorithms").
    while decays[:-steps].any():
        advantages[:-steps] += decays[:-steps] * advantages[steps:]
        decays[:-steps] *= decays[steps:]
        steps *= 2
    return advantages


Bootstraps = Callable[[EpisodeChunks], NDArray]
"""c chunks → (c,) bool: whether the value of each chunk's last observation counts."""


def select(column: Tensor, rows: Tensor) -> Tensor:
    """Return some rows of an observation's column.

    `index_select` copies them up to ten times as fast as indexing, but not unsigned integers of more than a byte.
    """
    return column[rows] if column.dtype in (torch.uint16, torch.uint32, torch.uint64) else column.index_select(0, rows)


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
    central: dict[str, Tensor] = field(default_factory=dict)
    """What a central critic gets besides the observations, with the same rows: column → (N, …)."""

    def __len__(self) -> int:
        return len(self.actions)

    @property
    def units(self) -> int:
        """The number of units that minibatches are drawn from: sequences if recurrent, otherwise steps."""
        return len(self) if self.sequences is None else len(self.sequences.starts)

    def take(self, units: Tensor | slice) -> "Minibatch":
        """Return the steps of some units, in order. A slice, only without sequences, copies observations only."""
        steps, memory = units, {}
        if self.sequences is not None:
            starts, lengths = self.sequences.starts[units], self.sequences.lengths[units]
            offsets = torch.arange(int(lengths.max()), device=starts.device)
            steps = (starts.unsqueeze(1) + offsets)[offsets < lengths.unsqueeze(1)]
            state = {key: value[units] for key, value in self.sequences.state.items()}
            memory = {Columns.SEQ_LENS: lengths, Columns.STATE_IN: state}
        columns = self._columns(steps)
        rows = columns.pop("acted")
        observations, central = (
            {name: select(value, rows) for name, value in part.items()} for part in (self.observations, self.central)
        )
        return Minibatch(inputs={Columns.OBS: observations, **memory}, central=central, **columns)

    def in_order(self, order: Tensor) -> "TrainBatch":
        """Return the steps in another order, without sequences."""
        return replace(self, **self._columns(order), sequences=None)

    def _columns(self, steps: Tensor | slice) -> dict[str, Any]:
        """Return the columns that have a row for each step, at some steps."""
        names = ("acted", "actions", "dist_inputs", "log_p", "advantages", "targets", "magnet", "taught")
        columns = {name: column for name in names if (column := getattr(self, name)) is not None}
        if isinstance(steps, slice):
            return {name: column[steps] for name, column in columns.items()}
        return {name: column.index_select(0, steps) for name, column in columns.items()}


@dataclass(frozen=True, slots=True)
class Minibatch:
    """Some steps of a TrainBatch.

    inputs: the arguments of the module's `forward_train`. central: what a central critic gets besides the observations.
    fraction: of the steps that all learners have together.
    """

    inputs: dict[str, Any]
    actions: Tensor
    dist_inputs: Tensor
    log_p: Tensor
    advantages: Tensor
    targets: Tensor
    magnet: Tensor | None = None
    taught: Tensor | None = None
    fraction: float = 1.0
    central: dict[str, Tensor] = field(default_factory=dict)


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
    critic: CentralCritic | None = None,
    scale: ReturnNormalization | None = None,
) -> TrainBatch:
    """Build a batch on the module's device, after updating the observation statistics.

    Args:
        module: The policy's module.
        samples: The policy's chunks, of one or more runners.
        gamma: Discount factor.
        lambda_: λ of the advantages.
        sequence: Maximum length of the sequences for a recurrent module.
        bootstraps: Selects the chunks whose last observation is bootstrapped from.
        critic: The value function; by default the module's own.
        scale: The units of the value function and the targets, which the targets update; by default those of returns.
    """
    device = next(module.parameters()).device
    lengths = np.concatenate([chunks.lengths for chunks in samples])
    acted = acted_rows(lengths)

    def column(values: NDArray) -> Tensor:
        return torch.from_numpy(values).to(device)

    observations = {
        name: column(np.concatenate([chunks.observations[name] for chunks in samples]))
        for name in samples[0].observations
    }
    module.update_statistics(observations)
    state = {key: column(np.concatenate([chunks.state[key] for chunks in samples])) for key in samples[0].state}
    central = {
        name: column(np.concatenate([chunks.central[name] for chunks in samples])) for name in samples[0].central
    }
    if critic is None:
        values, bootstrap = _values(module, observations, acted, lengths, state)
    else:
        critic.encoder.update_statistics(observations | central)
        values, bootstrap = _values(critic, observations | central, acted, lengths, {})
    if scale is not None:
        values, bootstrap = scale.denormalized(values), scale.denormalized(bootstrap)
    next_values = np.append(values[1:], 0.0)
    next_values[np.cumsum(lengths) - 1] = bootstrap * np.concatenate([bootstraps(chunks) for chunks in samples])
    rewards = np.concatenate([chunks.rewards for chunks in samples])
    lasts = np.zeros(len(acted), dtype=bool)
    lasts[np.cumsum(lengths) - 1] = True
    advantages = generalized_advantages(rewards, values, next_values, lasts, gamma, lambda_)
    targets = advantages + values
    explained_variance = float(1 - advantages.var() / max(targets.var(), 1e-8))
    if scale is not None:
        scale.update(torch.from_numpy(targets))
        targets = scale.normalized(targets)
    taught = [chunks.taught for chunks in samples if chunks.taught is not None]
    assert len(taught) in (0, len(samples)), "the teacher acts on all steps of a batch or on none"
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
        explained_variance=explained_variance,
        taught=column(np.concatenate(taught)) if taught else None,
        central=central,
    )


def _values(
    module: ActorCritic | CentralCritic,
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
    module: ActorCritic | CentralCritic, observations: dict[str, Tensor], rows: NDArray, state: dict[str, Tensor]
) -> tuple[NDArray, dict[str, Tensor]]:
    """Return the values of some rows, one step each from its own recurrent state, and the states after it."""
    values, states = [], []
    indices = torch.from_numpy(rows).to(next(iter(observations.values())).device)
    size = GPU_PASS_ROWS if indices.is_cuda else PASS_ROWS
    for first in range(0, len(rows), size):
        part = slice(first, first + size)
        batch = {
            Columns.OBS: {name: select(value, indices[part]) for name, value in observations.items()},
            Columns.STATE_IN: {key: value[part] for key, value in state.items()},
        }
        value, after = module.value_step(batch)
        values.append(value)
        states.append(after)
    return torch.cat(values).cpu().numpy(), {key: torch.cat([after[key] for after in states]) for key in state}


def minibatches(
    batches: Mapping[str, TrainBatch], *, size: int, epochs: int, rank: Rank = ALONE
) -> Iterator[dict[str, Minibatch]]:
    """Yield policy id → minibatch; each epoch visits each step of each policy once, in a new random order.

    Of several learners, each has its share of every minibatch.

    All policies have the same number of minibatches, given by the policy with the most steps and `size`. RLlib's
    MiniBatchCyclicIterator uses equal sizes instead, which repeats the few steps of a small policy many times per
    epoch. For recurrent policies, whole sequences are drawn.
    """
    count = -(-max(len(batch) for batch in batches.values()) // size)
    for _ in range(epochs):
        drawn = {policy: _epoch(batch, count, rank) for policy, batch in batches.items()}
        for parts in zip_longest(*drawn.values()):
            yield {policy: part for policy, part in zip(drawn, parts, strict=True) if part is not None}


def _epoch(batch: TrainBatch, count: int, rank: Rank) -> Iterator[Minibatch]:
    """Yield at most `count` minibatches, none of them empty."""
    # Drawn on the CPU, for the same order on every device.
    order = torch.randperm(batch.units).to(batch.acted.device)
    parts = [part for part in order.tensor_split(count) if len(part)]
    if rank.count > 1:
        for part in parts:
            share, fraction = rank.share(part, None if batch.sequences is None else batch.sequences.lengths)
            yield replace(batch.take(share), fraction=fraction)
    elif batch.sequences is not None:
        yield from map(batch.take, parts)
    else:
        # One copy of each column costs less than one for each minibatch.
        batch, stop = batch.in_order(order), 0
        for part in parts:
            start, stop = stop, stop + len(part)
            yield batch.take(slice(start, stop))
