"""The `training` section of each algorithm, selected by its key `algorithm`."""

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import Discriminator, Tag

from league.config.off_policy import DQNConfig, MADDPGConfig, QMIXConfig
from league.config.ppo import PPOConfig
from league.config.training import TrainingSettings

# A new algorithm needs an entry in each of the three definitions below.

AnyTraining = PPOConfig | DQNConfig | QMIXConfig | MADDPGConfig
ALGORITHMS: dict[str, type[TrainingSettings]] = {
    "ppo": PPOConfig,
    "dqn": DQNConfig,
    "qmix": QMIXConfig,
    "maddpg": MADDPGConfig,
}


def _algorithm(settings: Any) -> str:
    if isinstance(settings, Mapping):
        return str(settings.get("algorithm", "ppo"))
    return str(getattr(settings, "algorithm", "ppo"))


TrainingConfig = Annotated[
    Annotated[PPOConfig, Tag("ppo")]
    | Annotated[DQNConfig, Tag("dqn")]
    | Annotated[QMIXConfig, Tag("qmix")]
    | Annotated[MADDPGConfig, Tag("maddpg")],
    Discriminator(_algorithm),
]
"""Settings of one algorithm, discriminated by `algorithm`."""
