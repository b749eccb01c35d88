"""Episode chunks → train batch of one policy, a column at a time.

RLlib's default learner pipeline handles each time step as a Python object. Here the chunks of a policy are
concatenated, their observations, T + 1 per chunk of T steps, are valued in a few passes, and the last of each chunk
serves as bootstrap: 0 where the agent terminated, its value where the agent was truncated or the chunk was cut.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from ray.rllib.core.columns import Columns
from ray.rllib.env.single_agent_episode import SingleAgentEpisode
from torch import Tensor

from training.learners.advantages import generalized_advantages
from training.modules.actor_critic import ActorCritic

Chunks = Sequence[SingleAgentEpisode]
Bootstraps = Callable[[Chunks], NDArray]
"""Chunks → (c,) bool: whether the value of the last observation of each counts."""

VALUED_AT_ONCE = 2048
"""Rows of one pass: of pictures as floats, more than a few thousand fill the memory."""


@dataclass(frozen=True, slots=True)
class Sequences:
    """Steps that follow one another, of a policy with a memory. Sequence i is steps starts[i] … + lengths[i] - 1.

    starts, lengths: (S,). state: key → (S, width), that each began from.
    """

    starts: Tensor
    lengths: Tensor
    state: dict[str, Tensor]


@dataclass(frozen=True, slots=True)
class TrainBatch:
    """n steps of one policy.

    observations: ONNX input name → (N, …) in the environment's dtype, N ≥ n; those of the steps are rows `acted`, (n,),
    so that pictures are not copied once more. actions: raw, (n,) or (n, m). dist_inputs: (n, d), that they were drawn
    by. log_p, advantages (standardised), targets (of the value function): (n,) float32.
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

    def __len__(self) -> int:
        return len(self.actions)

    @property
    def units(self) -> int:
        """What minibatches are drawn from: sequences with a memory, else steps."""
        return len(self) if self.sequences is None else len(self.sequences.starts)

    def take(self, units: Tensor) -> "Minibatch":
        """The steps of some units, in order."""
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
        )


@dataclass(frozen=True, slots=True)
class Minibatch:
    """Some steps of a TrainBatch. inputs: what `forward_train` of the policy's module takes."""

    inputs: dict[str, Any]
    actions: Tensor
    dist_inputs: Tensor
    log_p: Tensor
    advantages: Tensor
    targets: Tensor


def unless_terminated(chunks: Chunks) -> NDArray:
    """Only what follows a terminal state is worth nothing: a truncated agent could have gone on."""
    return np.array([not chunk.is_terminated for chunk in chunks])


def train_batch(
    module: ActorCritic,
    chunks: Chunks,
    *,
    gamma: float,
    lambda_: float,
    sequence: int | None = None,
    bootstraps: Bootstraps = unless_terminated,
) -> TrainBatch:
    """The steps of non-empty `chunks`, on the module's device. Updates the module's observation statistics first.

    sequence: steps of the sequences that chunks are cut into, of a module with a memory.
    """
    device = next(module.parameters()).device
    lengths = np.array([len(chunk) for chunk in chunks])
    acted = np.delete(np.arange(lengths.sum() + len(chunks)), np.cumsum(lengths + 1) - 1)
    observations = {
        name: torch.from_numpy(np.concatenate([chunk.observations.data[name] for chunk in chunks])).to(device)
        for name in chunks[0].observations.data
    }
    module.encoder.update_statistics(observations)
    state = {key: torch.from_numpy(column).to(device) for key, column in _states(chunks).items()}
    values, bootstrap = _values(module, observations, acted, lengths, state)
    next_values = np.append(values[1:], 0.0)
    next_values[np.cumsum(lengths) - 1] = bootstrap * bootstraps(chunks)
    rewards = np.concatenate([chunk.rewards.data for chunk in chunks])
    lasts = np.zeros(len(acted), dtype=bool)
    lasts[np.cumsum(lengths) - 1] = True
    advantages = generalized_advantages(rewards, values, next_values, lasts, gamma, lambda_)
    targets = advantages + values

    def column(values: NDArray) -> Tensor:
        return torch.from_numpy(values).to(device)

    return TrainBatch(
        observations=observations,
        acted=column(acted),
        actions=column(np.concatenate([chunk.actions.data for chunk in chunks])),
        dist_inputs=column(_outputs(chunks, Columns.ACTION_DIST_INPUTS)),
        log_p=column(_outputs(chunks, Columns.ACTION_LOGP)),
        advantages=column(_standardized(advantages).astype(np.float32)),
        targets=column(targets.astype(np.float32)),
        sequences=_sequences(lengths, sequence, state) if sequence is not None and state else None,
        explained_variance=float(1 - advantages.var() / max(targets.var(), 1e-8)),
    )


def _values(
    module: ActorCritic,
    observations: dict[str, Tensor],
    acted: NDArray,
    lengths: NDArray,
    state: dict[str, Tensor],
) -> tuple[NDArray, NDArray]:
    """Values of the steps' observations (n,), and of the last observation of each chunk (c,)."""
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
    """Values of some rows of the observations, one step each from its own state, and the states after."""
    values, states = [], []
    for first in range(0, len(rows), VALUED_AT_ONCE):
        part = slice(first, first + VALUED_AT_ONCE)
        batch = {
            Columns.OBS: {name: value[rows[part]] for name, value in observations.items()},
            Columns.STATE_IN: {key: value[part] for key, value in state.items()},
        }
        value, after = module.value_step(batch)
        values.append(value.cpu().numpy())
        states.append(after)
    return np.concatenate(values), {key: torch.cat([after[key] for after in states]) for key in state}


def _states(chunks: Chunks) -> dict[str, NDArray]:
    """key → (n, width), the state that each step began from; empty without a memory."""
    if Columns.STATE_IN not in chunks[0].extra_model_outputs:
        return {}
    columns = [chunk.extra_model_outputs[Columns.STATE_IN].data for chunk in chunks]
    return {key: np.concatenate([column[key] for column in columns]) for key in columns[0]}


def _sequences(lengths: NDArray, sequence: int, state: dict[str, Tensor]) -> Sequences:
    """Cut each chunk into sequences of `sequence` steps and a rest."""
    firsts = np.cumsum(lengths) - lengths
    starts = np.concatenate([first + np.arange(0, n, sequence) for first, n in zip(firsts, lengths, strict=True)])
    stops = np.append(starts[1:], lengths.sum())
    begun = {key: value[starts] for key, value in state.items()}
    device = next(iter(begun.values())).device
    return Sequences(torch.from_numpy(starts).to(device), torch.from_numpy(stops - starts).to(device), begun)


def _outputs(chunks: Chunks, column: str) -> NDArray:
    return np.concatenate([chunk.extra_model_outputs[column].data for chunk in chunks])


def _standardized(values: NDArray) -> NDArray:
    return (values - values.mean()) / max(1e-4, values.std())
