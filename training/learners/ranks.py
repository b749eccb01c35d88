"""The learners of an update, connected by torch.distributed: each takes its share of every minibatch.

Each has the same weights, the same train batch and the same random order. A gradient is the sum over their shares, so
that an update equals that of one learner with the same minibatches, up to rounding.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import timedelta

import torch
import torch.distributed
from torch import Tensor
from torch.distributed import TCPStore as TCPStore  # type: ignore[attr-defined]

from league.errors import LeagueError

TIMEOUT = timedelta(minutes=2)
"""How long a learner waits for the others. A process that ends closes its connections, which is noticed at once."""


class LearnerLost(LeagueError):
    """Another learner ended, or cannot be reached."""


@dataclass(frozen=True, slots=True)
class Rank:
    """The place of this learner among `count` learners. index: from 0."""

    index: int = 0
    count: int = 1

    def share(self, units: Tensor, lengths: Tensor | None) -> tuple[Tensor, float]:
        """Return this learner's part of some units, and the fraction of their steps that it contains.

        A learner whose part is empty gets one unit with a fraction of 0, so that all take part in the same gradients.
        lengths: the steps of every unit; None for one each.
        """
        part = units.tensor_split(self.count)[self.index]
        fraction = len(part) / len(units) if lengths is None else float(lengths[part].sum() / lengths[units].sum())
        return (part if len(part) else units[:1]), fraction

    def add(self, tensors: Sequence[Tensor]) -> None:
        """Replace tensors of one dtype by their sums over all learners, which have the same shapes there.

        Raises LearnerLost if another learner has ended.
        """
        if self.count == 1:
            return
        flat = torch.cat([tensor.reshape(-1) for tensor in tensors])
        try:
            torch.distributed.all_reduce(flat)
        except RuntimeError as error:
            raise LearnerLost(f"learner {self.index} lost its connection to the others: {error}") from error
        for tensor, total in zip(tensors, flat.split([tensor.numel() for tensor in tensors]), strict=True):
            tensor.copy_(total.view_as(tensor))


ALONE = Rank()


def connect(rank: Rank, store: TCPStore, backend: str) -> None:
    """Connect this process with the other learners; returns when all have called it.

    Args:
        rank: Of this learner.
        store: Through which they find each other: the first learner's, or a connection to it.
        backend: `gloo`, or `nccl` if each learner has a GPU of its own.
    """
    torch.distributed.init_process_group(backend, store=store, rank=rank.index, world_size=rank.count, timeout=TIMEOUT)
