"""Settings of PPO."""

from typing import Literal, Self

from pydantic import Field, model_validator

from league.config.base import ContestantRef, Part
from league.config.network import RecurrenceConfig
from league.config.schedules import Scheduled, ScheduledPositive
from league.config.training import TrainingSettings

UNIFORM, PREVIOUS = "uniform", "previous"
Critic = Literal["own", "central", "state"]


class PolicySettings(Part):
    """Settings of PPO for one policy; null for the common value. See PPOConfig."""

    lr: ScheduledPositive | None = None
    gamma: float | None = Field(default=None, ge=0, le=1)
    lambda_: float | None = Field(default=None, ge=0, le=1, alias="lambda")
    clip: ScheduledPositive | None = None
    entropy: Scheduled | None = None


class MagnetConfig(Part):
    """A reference policy ρ, and the weight of KL(π ‖ ρ) in the loss. Keeps policies close to ρ, and makes self-play
    converge in games with hidden information."""

    ref: str
    """`uniform` over the legal actions; `previous`: the policy itself, as it was some updates ago; or a version
    (`leduc_holdem@3`, `@champion`), which is resolved when training starts."""
    weight: Scheduled
    """Coefficient of the divergence."""
    every: int | None = Field(default=None, ge=1)
    """Updates after which `previous` is refreshed."""

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if (self.ref == PREVIOUS) != (self.every is not None):
            raise ValueError("magnet.every is required for ref: previous, and only there")
        if self.version is not None and "@" not in self.version:
            raise ValueError(f"magnet.ref: expected uniform, previous or a version, got {self.ref!r}")
        return self

    @property
    def version(self) -> str | None:
        """The reference of a version; None for `uniform` and `previous`."""
        return None if self.ref in (UNIFORM, PREVIOUS) else self.ref


class TeacherConfig(Part):
    """A policy whose actions are imitated, and the weight of the imitation in the loss."""

    ref: ContestantRef
    """A script (`script:one_ply`), a bot (`script:my_package.module:name`), a version (`connect_four@3`), or an alias,
    which is resolved when training starts. `@3` and `@champion` refer to the league itself."""
    weight: Scheduled
    """Coefficient of the cross-entropy of the teacher's actions."""


class PPOConfig(TrainingSettings):
    """Proximal policy optimisation (Schulman et al., 2017, arXiv 1707.06347)."""

    algorithm: str = "ppo"
    lr: ScheduledPositive = 5e-4
    """Learning rate of Adam."""
    train_batch_size: int = Field(default=4096, ge=1)
    """Actions per update."""
    minibatch_size: int = Field(default=512, ge=1)
    """Actions per gradient step."""
    lag: int = Field(default=1, ge=0, le=8)
    """Age of the weights that sample, in updates: update k learns from actions of the weights after update k − 1 − lag,
    or of the last checkpoint if it is later; at most 8. Sampling and learning overlap with 1; with 0, and with
    `runners: 0`, they alternate."""
    epochs: int = Field(default=4, ge=1)
    """Passes over each train batch."""
    lambda_: float = Field(default=0.95, ge=0, le=1, alias="lambda")
    """λ of generalised advantage estimation."""
    clip: ScheduledPositive = 0.2
    """Clipping range of the probability ratio."""
    entropy: Scheduled = 0.05
    """Coefficient of the entropy bonus."""
    value_loss: float = Field(default=0.5, ge=0)
    """Coefficient of the value loss."""
    critic: Critic = "own"
    """What the value function gets while learning. own: its agent's observation. central: also the latest observations
    of all agents, as in MAPPO (Yu et al., 2022, arXiv 2103.01955). state: also the environment's `state()`."""
    normalize_values: bool = False
    """Learn values in units of the running mean and deviation of returns."""
    magnet: MagnetConfig | None = None
    """Pull towards a reference policy; null for none."""
    teacher: TeacherConfig | None = None
    """Imitation of another policy's actions; null for none."""
    recurrence: RecurrenceConfig | None = None
    """Recurrent layer; null for none."""
    shared_encoder: bool = False
    """Share the convolutions and hidden layers among all policies. Heads are separate."""
    per_policy: dict[str, PolicySettings] = Field(default={})
    """Policy id → settings that differ from the common ones."""

    @model_validator(mode="after")
    def _settings_fit(self) -> Self:
        if self.minibatch_size > self.train_batch_size:
            raise ValueError(f"minibatch_size must be at most train_batch_size ({self.train_batch_size})")
        if self.shared_encoder and self.recurrence is not None:
            raise ValueError("shared_encoder does not support recurrence")
        if self.recurrence is not None and self.magnet is not None and self.magnet.ref != UNIFORM:
            raise ValueError(f"magnet.ref {self.magnet.ref} does not support recurrence: expected {UNIFORM}")
        return self
