"""The `training` section of each algorithm, selected by its key `algorithm`."""

from collections.abc import Mapping
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Union

from pydantic import Discriminator, SerializeAsAny, Tag, field_validator

from league.config.base import check_entry_point
from league.config.marwil import MARWILConfig
from league.config.off_policy import DQNConfig, MADDPGConfig, QMIXConfig
from league.config.ppo import PPOConfig
from league.config.training import TrainingSettings

ALGORITHMS: dict[str, type[TrainingSettings]] = {
    "ppo": PPOConfig,
    "marwil": MARWILConfig,
    "dqn": DQNConfig,
    "qmix": QMIXConfig,
    "maddpg": MADDPGConfig,
}
"""Algorithms whose settings are validated wherever a configuration is read, without importing what trains. Any other
algorithm, of users or of this project, is an entry point, or the name of an installed one in GROUP."""
GROUP = "policy_league.algorithms"
OWN = "own"
IMPORTED: dict[str, type[TrainingSettings]] = {}
"""Entry point → settings, of the algorithms that this process has imported to train."""


class OwnSettings(TrainingSettings, extra="allow"):
    """Settings of an algorithm that is an entry point. Those of this algorithm alone are validated where it trains."""

    replaced_by_network: ClassVar[tuple[str, ...]] = ()

    @field_validator("algorithm")
    @classmethod
    def _resolved(cls, value: str) -> str:
        """Return the entry point: where the package is not installed, its name means nothing."""
        if ":" in value:
            return check_entry_point(value)
        installed = entry_points(group=GROUP)
        if value not in installed.names:
            names = ", ".join((*ALGORITHMS, *sorted(installed.names)))
            raise ValueError(f"expected one of {names}, or package.module:Class, got {value!r}")
        return installed[value].value


def _tag(settings: Any) -> str:
    has_keys = isinstance(settings, Mapping)
    name = str(settings.get("algorithm", "ppo") if has_keys else getattr(settings, "algorithm", "ppo"))
    return name if name in ALGORITHMS else OWN


if TYPE_CHECKING:
    TrainingConfig = TrainingSettings
else:
    TrainingConfig = SerializeAsAny[
        Annotated[
            Union[*(Annotated[model, Tag(name)] for name, model in {**ALGORITHMS, OWN: OwnSettings}.items())],
            Discriminator(_tag),
        ]
    ]
"""Settings of one algorithm, discriminated by `algorithm`."""
