"""The `training` section: settings common to all algorithms; and the `nightly` section."""

from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, field_validator

from league.config.base import Part
from league.config.network import Channels, ConvolutionConfig
from league.config.opponents import OpponentsConfig

DEFAULT_STEPS = 1_000_000
DEFAULT_CHECKPOINT_EVERY = 200_000
FIXED_FOR_EXPLOITERS = frozenset(
    ("algorithm", "seed", "steps", "minutes", "checkpoint_every", "checkpoint_minutes", "opponents", "exploiter")
)
"""Settings that the command, the night or the gate determines for an exploiter."""


class PhaseConfig(Part):
    """A phase of training in which only some policies learn."""

    policies: tuple[str, ...] = Field(min_length=1)
    iterations: int = Field(ge=1)
    """Number of updates. The phases are repeated in order."""


class StrengthConfig(Part):
    """Each version that a run publishes plays the champion and an anchor, in a process of low priority."""

    games: int = Field(default=200, ge=2)
    """Number of games per opponent, rounded down to blocks of two. Their seeds are the same for all versions."""


class TrainingSettings(Part):
    """Settings common to all algorithms."""

    supports_opponents: ClassVar[bool] = True
    """Whether the algorithm can train against opponents, which exploiters need."""
    seed: int = Field(default=0, ge=0)
    """Seed of the run, from which all random choices are derived."""
    seeds: Literal["stock", "fast"] = "stock"
    """How episodes are drawn. stock: with the random numbers of the stock environment, as in matches. fast: by a faster
    generator of the vectorised environment, with the same distribution; equal runs stay equal."""
    steps: int | None = Field(default=None, ge=1)
    """Number of actions of all agents after which training ends; null: 1,000,000, or unlimited if `minutes` is set."""
    minutes: float | None = Field(default=None, gt=0)
    """Wall-clock limit of training; the earlier of the two limits applies."""
    checkpoint_every: Annotated[int, Field(ge=1)] | Literal["auto"] | None = "auto"
    """Number of actions between published versions; null: none. auto: 200,000, or none if `checkpoint_minutes` is set.
    The end of training also publishes, unless time ends it within a quarter of an interval after the last version."""
    checkpoint_minutes: float | None = Field(default=None, gt=0)
    """Wall-clock minutes between published versions; the earlier of the two intervals applies."""
    runners: int = Field(default=1, ge=0)
    """Number of sampling processes (env runners); 0 samples in the learner's process."""
    num_envs: Annotated[int, Field(ge=1)] | Literal["auto"] = "auto"
    """Environments stepped in parallel in each runner. auto: 32; with PPO and a vectorised environment up to 512, as
    long as each agent gets 16 steps of each environment per batch."""
    gamma: float = Field(default=0.99, ge=0, le=1)
    """Discount factor per turn of an agent."""
    grad_clip: float = Field(default=0.5, gt=0)
    """Maximum global norm of the gradient."""
    convolutions: tuple[ConvolutionConfig, ...] = ()
    """Convolutions for image-like parts of the observation, with three axes. Other parts are flattened."""
    channels: Channels | None = None
    """The axis of the channels of images, (height, width, channels) or (channels, height, width). null: `first` if the
    first axis is at most half as long as both others, else `last`."""
    hidden: tuple[int, ...] = Field(default=(256, 256), min_length=1)
    """Widths of the hidden layers."""
    normalize_observations: bool = False
    """Normalize each observation feature by its running mean and standard deviation, inside the exported graph."""
    policies_to_train: tuple[str, ...] | tuple[PhaseConfig, ...] | None = None
    """The policies that learn, or repeated phases; null for all. Other policies keep their weights: those of the parent
    version (`--from`), or their initial weights."""
    opponents: OpponentsConfig = OpponentsConfig()
    """Opponents. In their episodes one random side learns, and the opponent controls all others."""
    exploiter: dict[str, Any] = Field(default_factory=dict)
    """Training settings that are different for exploiters. What makes a policy hard to exploit, such as a magnet or a
    high entropy, makes an exploiter weak."""
    strength: StrengthConfig | None = StrengthConfig()
    """Matches of each published version against the champion and an anchor; null plays none."""
    gpus: float = Field(default=0, ge=0)
    """GPUs of the learner; a fraction shares a GPU."""
    runner_gpus: float = Field(default=0, ge=0)
    """GPUs of each runner for inference."""
    crashes: int = Field(default=3, ge=0)
    """Maximum number of consecutive exceptions after which an environment is recreated; the next one ends training."""
    opening_plies: int | None = Field(default=None, ge=0)
    """Maximum number of random legal moves at the start of each episode. They are excluded from training and lead to
    positions that self-play alone would not visit. Null: `play.opening_plies`, so that training visits the positions
    that matches start from."""

    @field_validator("exploiter")
    @classmethod
    def _differences_are_possible(cls, value: dict[str, Any]) -> dict[str, Any]:
        if fixed := sorted(FIXED_FOR_EXPLOITERS & value.keys()):
            raise ValueError(f"{', '.join(fixed)} cannot be set for exploiters only")
        return value

    @property
    def max_steps(self) -> int | None:
        """Number of actions after which training ends; None if only the time is limited."""
        return DEFAULT_STEPS if self.steps is None and self.minutes is None else self.steps

    @property
    def checkpoint_steps(self) -> int | None:
        """Number of actions between published versions; None without such an interval."""
        if self.checkpoint_every == "auto":
            return DEFAULT_CHECKPOINT_EVERY if self.checkpoint_minutes is None else None
        return self.checkpoint_every

    def budget_spent(self, steps: int, seconds: float) -> float:
        """Return the fraction of the budget that a run has spent, of steps or of time, whichever is larger; at most 1.

        Args:
            steps: Actions of the run, without those of parent versions.
            seconds: Training time of the run.
        """
        of_steps = steps / self.max_steps if self.max_steps is not None else 0.0
        of_time = seconds / (60 * self.minutes) if self.minutes is not None else 0.0
        return min(max(of_steps, of_time), 1.0)


class NightlyConfig(Part):
    """The `nightly` section: the training of `league nightly --train`. Null: the value of the `training` section."""

    minutes: float | None = Field(default=None, gt=0)
    """Maximum training time of a night."""
    steps: int | None = Field(default=None, ge=1)
    """Maximum number of actions of a night."""
    opponents: OpponentsConfig | None = None
    """Opponents."""
    exploiter: float = Field(default=0.15, ge=0, le=1)
    """Budget of the champion's exploiter, as a fraction of the night's; 0 trains none."""
