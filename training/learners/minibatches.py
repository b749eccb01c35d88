"""Minibatches of several policies' train batches."""

from collections.abc import Iterator

import torch
from ray.rllib.policy.sample_batch import MultiAgentBatch, SampleBatch


class Minibatches:
    """Each row of each policy exactly once per epoch, in a random order that is new in each.

    All policies are cut into the same number of minibatches: as many as the largest needs at `minibatch_size`. RLlib's
    MiniBatchCyclicIterator gives each policy equally large minibatches instead, and so a policy with few rows many
    times the epochs that were asked for.
    """

    def __init__(self, batch: MultiAgentBatch, *, minibatch_size: int, num_epochs: int) -> None:
        self._batches = batch.policy_batches
        self._env_steps = batch.env_steps()
        self._epochs = num_epochs
        largest = max(len(rows) for rows in self._batches.values())
        self._count = -(-largest // minibatch_size)

    def __iter__(self) -> Iterator[MultiAgentBatch]:
        for _ in range(self._epochs):
            orders = {
                policy: torch.randperm(len(rows)).tensor_split(self._count) for policy, rows in self._batches.items()
            }
            for i in range(self._count):
                yield MultiAgentBatch(
                    {
                        policy: _take(self._batches[policy], order[i])
                        for policy, order in orders.items()
                        if len(order[i])
                    },
                    env_steps=self._env_steps,
                )


def _take(rows: SampleBatch, order: torch.Tensor) -> SampleBatch:
    return SampleBatch(
        {
            column: {name: part[order] for name, part in value.items()} if isinstance(value, dict) else value[order]
            for column, value in rows.items()
        }
    )
