"""Minibatches of several policies' train batches."""

from collections.abc import Iterator, Mapping

import torch

from training.learners.train_batch import Minibatch, TrainBatch


def minibatches(batches: Mapping[str, TrainBatch], *, size: int, epochs: int) -> Iterator[dict[str, Minibatch]]:
    """Each step of each policy exactly once per epoch, in a random order that is new in each; policy id → its steps.

    All policies are cut into the same number of minibatches: as many as the largest needs at `size` steps. RLlib's
    MiniBatchCyclicIterator gives each policy equally large minibatches instead, and so a policy with few steps many
    times the epochs that were asked for. Of policies with a memory, whole sequences are drawn.
    """
    count = -(-max(len(batch) for batch in batches.values()) // size)
    for _ in range(epochs):
        orders = {policy: _order(batch).tensor_split(count) for policy, batch in batches.items()}
        for i in range(count):
            yield {policy: batches[policy].take(order[i]) for policy, order in orders.items() if len(order[i])}


def _order(batch: TrainBatch) -> torch.Tensor:
    # Drawn on the CPU: the same order on every device.
    return torch.randperm(batch.units).to(batch.acted.device)
