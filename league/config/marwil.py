"""Settings of MARWIL."""

from pathlib import Path
from typing import ClassVar, Literal, Self

from pydantic import Field, field_validator, model_validator

from league.config.ppo import PPOConfig
from league.config.schedules import Scheduled


class MARWILConfig(PPOConfig):
    """Behaviour cloning and monotonic advantage re-weighted imitation learning (Wang et al., 2018, "Exponentially
    weighted imitation learning for batched historical data"). It learns from recorded games, and plays none."""

    supports_opponents: ClassVar[bool] = False
    unused: ClassVar[tuple[str, ...]] = (
        *("lag", "clip", "entropy", "critic", "magnet", "teacher", "recurrence", "opponents", "curriculum"),
    )
    """Settings of PPO that have no effect on recorded games."""
    algorithm: Literal["marwil"] = "marwil"
    data: str
    """Directory with a file `POLICY.parquet` for each policy, as `league export-games` writes them."""
    beta: float = Field(default=0.0, ge=0)
    """β, the exponent of the standardised advantages that weight the actions: 0 imitates all of them equally, which is
    behaviour cloning; larger values imitate those that led to higher returns than expected."""
    epochs: int = Field(default=1, ge=1)
    """Passes over each train batch."""
    lambda_: float = Field(default=1.0, ge=0, le=1, alias="lambda")
    """λ of generalised advantage estimation. 1: advantages and targets of values are the recorded returns."""
    entropy: Scheduled = 0.0
    lag: int = 0
    runners: int = Field(default=0, ge=0)
    """Processes that read the games, each of which has all of them in memory; 0: the learner's."""

    @field_validator("data")
    @classmethod
    def _is_absolute(cls, value: str) -> str:
        return str(Path(value).absolute())

    @model_validator(mode="after")
    def _has_an_effect(self) -> Self:
        self.refuse(self.unused, "{}: marwil learns from recorded games, on which it has no effect: remove it")
        return self
