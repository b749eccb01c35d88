"""Parts of PPO's value functions that only learning uses: central critics, and the scale of returns.

Yu et al., 2022, "The surprising effectiveness of PPO in cooperative multi-agent games", arXiv 2103.01955.
"""

from typing import Any

from numpy.typing import NDArray
from ray.rllib.core.columns import Columns
from torch import Tensor, nn

from training.modules.encoder import MIN_VARIANCE, Encoder, RunningNormalization, linear


class CentralCritic(nn.Module):
    """Value of an agent's observation and central columns (training/sampling/central_observations.py), section 5.2.

    It has layers of its own and no memory, also beside a recurrent policy. encoder: of all these columns.
    """

    def __init__(self, encoder: Encoder) -> None:
        super().__init__()
        self.encoder = encoder
        self.head = linear(encoder.width, 1, gain=1.0)

    def forward(self, columns: dict[str, Tensor]) -> Tensor:
        """Column → (B, …), to (B,)."""
        return self.head(self.encoder(columns)).squeeze(-1)

    def value_step(self, batch: dict[str, Any]) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the values of a batch, (B,), and no state. See ActorCritic."""
        return self(batch[Columns.OBS]), {}


class ReturnNormalization(RunningNormalization):
    """The running mean and deviation of the returns that a value function learns, section 5.1.

    The network's outputs are in these units. Without PopArt's correction (Hessel et al., 2019, arXiv 1809.04474),
    a change of the units changes all values alike.
    """

    def __init__(self) -> None:
        super().__init__(())

    @property
    def deviation(self) -> float:
        """The deviation of the returns."""
        return float(self.variance + MIN_VARIANCE) ** 0.5

    def normalized(self, returns: NDArray) -> NDArray:
        """(n,) returns → (n,) in the network's units, not clipped."""
        return (returns - float(self.mean)) / self.deviation

    def denormalized(self, outputs: NDArray) -> NDArray:
        """(n,) outputs of the network → (n,) values."""
        return outputs * self.deviation + float(self.mean)
