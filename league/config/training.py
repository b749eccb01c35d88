"""The `training` section: settings common to all algorithms; and the `nightly` section."""

from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import AfterValidator, Field, field_validator, model_validator

from league.config.base import JSON, EntryPoint, Part
from league.config.environment import WrapperConfig
from league.config.network import Channels, ConvolutionConfig, NetworkConfig
from league.config.opponents import OpponentsConfig
from league.random.seeds import generator

DEFAULT_STEPS = 1_000_000
DEFAULT_CHECKPOINT_EVERY = 200_000
MAX_BATCH_SCALE = 64
FIXED_FOR_EXPLOITERS = frozenset(
    ("algorithm", "seed", "steps", "minutes", "checkpoint_every", "checkpoint_minutes", "opponents", "exploiter")
)
"""Settings that the command, the night or the gate determines for an exploiter."""


TRACKERS = ("wandb", "mlflow", "comet", "aim")


def _check_tracker(name: str) -> str:
    if name not in TRACKERS and not all(name.partition(":")):
        raise ValueError(f"expected {', '.join(TRACKERS)} or package.module:Class, got {name!r}")
    return name


TrackerName = Annotated[str, AfterValidator(_check_tracker)]
"""One of TRACKERS, or a class of the user's code."""


class PhaseConfig(Part):
    """A phase of training in which only some policies learn."""

    policies: tuple[str, ...] = Field(min_length=1)
    iterations: int = Field(ge=1)
    """Number of updates. The phases are repeated in order."""


class StageConfig(Part):
    """A stage of a curriculum: arguments of the environment, and what ends it."""

    kwargs: JSON = Field(default={})
    """Arguments of the environment's constructor, besides `environment.kwargs` or in place of them. A distribution,
    `{uniform: [low, high]}` or `{choice: [value, …]}` as in a sweep, is drawn for each episode from its seed."""
    steps: int | None = Field(default=None, ge=1)
    """Number of actions of all agents after which the stage ends."""
    until: dict[str, float] = Field(default={})
    """Curve → value: the stage ends once all these curves have at least these values in several updates."""

    @field_validator("kwargs")
    @classmethod
    def _distributions_can_be_drawn(cls, value: JSON) -> JSON:
        for name, argument in value.items():
            match _distribution(argument):
                case None | ("choice", [_, *_]):
                    pass
                case "uniform", [int() | float() as low, int() | float() as high] if low < high:
                    pass
                case "choice", _:
                    raise ValueError(f"{name}: expected choice: [value, …], got {argument!r}")
                case _:
                    raise ValueError(f"{name}: expected uniform: [low, high] with low < high, got {argument!r}")
        return value

    @property
    def ends(self) -> bool:
        """Whether anything ends the stage."""
        return self.steps is not None or bool(self.until)

    @property
    def is_random(self) -> bool:
        """Whether arguments are drawn for each episode."""
        return any(_distribution(argument) for argument in self.kwargs.values())

    def drawn(self, seed: int) -> JSON:
        """Return the arguments of the episode with this seed."""
        kwargs, rng = dict(self.kwargs), generator(seed, "curriculum")
        for name, argument in self.kwargs.items():
            match _distribution(argument):
                case "choice", values:
                    kwargs[name] = values[rng.integers(len(values))]
                case "uniform", (low, high):
                    kwargs[name] = float(rng.uniform(low, high))
        return kwargs

    def extremes(self) -> list[JSON]:
        """Return arguments in which each value of a choice and both bounds of an interval occur."""
        drawn = {name: part[1] for name, argument in self.kwargs.items() if (part := _distribution(argument))}
        number = max(map(len, drawn.values()), default=1)
        return [self.kwargs | {name: values[i % len(values)] for name, values in drawn.items()} for i in range(number)]


def _distribution(argument: Any) -> tuple[str, Any] | None:
    """Return name and parameters of a distribution; None for another argument."""
    if isinstance(argument, dict) and len(argument) == 1:
        ((name, parameters),) = argument.items()
        return (name, parameters) if name in ("choice", "uniform") else None
    return None


class StrengthConfig(Part):
    """Each version that a run publishes plays the champion and an anchor, in a process of low priority."""

    games: int = Field(default=200, ge=2)
    """Number of games per opponent, rounded down to blocks of two. Their seeds are the same for all versions."""


class TrainingSettings(Part):
    """Settings common to all algorithms."""

    supports_opponents: ClassVar[bool] = True
    """Whether the algorithm can train against opponents, which exploiters need."""
    replaced_by_network: ClassVar[tuple[str, ...]] = ("convolutions", "channels", "hidden")
    """Settings without effect if `network` is set."""
    algorithm: str
    """The algorithm: its name, or a class of the user's code, `package.module:Class`. docs/extending.md describes the
    interface for authors."""
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
    runners: Annotated[int, Field(ge=0)] | Literal["auto"] = "auto"
    """Number of sampling processes (env runners); 0 samples in the learner's process. auto, here and below: what fits
    the cores and GPUs that the run begins with (training/algorithms/resources.py)."""
    num_envs: Annotated[int, Field(ge=1)] | Literal["auto"] = "auto"
    """Environments stepped in parallel in each runner. auto: 32; with PPO so many that each agent gets 16 steps of each
    environment per batch, up to 32, or 512 of a vectorised environment."""
    batch_scale: Annotated[int, Field(ge=1, le=MAX_BATCH_SCALE)] | Literal["auto"] = "auto"
    """Factor of `train_batch_size` and `minibatch_size`, with PPO; the learning rate grows with its square root. auto:
    1, or more for vectorised environments on a GPU or many cores."""
    learners: Annotated[int, Field(ge=1)] | Literal["auto"] = "auto"
    """Number of learning processes (learners), with PPO: several only on GPUs. Each has its share of every minibatch,
    and their gradients are averaged. auto: 1."""
    threads: Annotated[int, Field(ge=1)] | Literal["auto"] = "auto"
    """Threads of each learner. auto: up to four, of the cores that the runners leave."""
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
    network: NetworkConfig | None = None
    """A network of the user's code, from observations to features, in place of convolutions and hidden layers; null for
    none. docs/extending.md describes the interface for authors."""
    normalize_observations: bool = False
    """Normalize each observation feature by its running mean and standard deviation, inside the exported graph."""
    callbacks: tuple[EntryPoint, ...] = ()
    """Classes of the user's code that follow training and add metrics. docs/extending.md describes the interface for
    authors."""
    wrappers: tuple[WrapperConfig, ...] = ()
    """Wrappers of the environment in training only, outside of `environment.wrappers`. They must not change spaces."""
    curriculum: tuple[StageConfig, ...] = ()
    """Stages of training in environments with other arguments, in order; the last one lasts until the end."""
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
    trackers: tuple[TrackerName, ...] = ()
    """Experiment trackers that the run reports to, besides TensorBoard. docs/extending.md describes the interface for
    authors."""
    gpus: Annotated[float, Field(ge=0)] | Literal["auto"] = "auto"
    """GPUs of each learner; a fraction shares a GPU. auto: one for PPO with convolutions, a network of the user's code
    or a layer of at least 1,024 units, if there is one and runners use none."""
    runner_gpus: float = Field(default=0, ge=0)
    """GPUs of each runner for inference."""
    crashes: int = Field(default=3, ge=0)
    """Maximum number of consecutive exceptions after which an environment is recreated; the next one ends training."""
    opening_plies: int | None = Field(default=None, ge=0)
    """Maximum number of random legal moves at the start of each episode. They are excluded from training and lead to
    positions that self-play alone would not visit. Null: `play.opening_plies`, so that training visits the positions
    that matches start from."""

    @field_validator("trackers")
    @classmethod
    def _trackers_are_different(cls, value: tuple[TrackerName, ...]) -> tuple[TrackerName, ...]:
        if len(set(value)) < len(value):
            raise ValueError(f"expected each tracker once, got {', '.join(value)}")
        return value

    @field_validator("curriculum")
    @classmethod
    def _all_stages_but_the_last_end(cls, value: tuple[StageConfig, ...]) -> tuple[StageConfig, ...]:
        for number, stage in enumerate(value, 1):
            if number < len(value) and not stage.ends:
                raise ValueError(f"stage {number} never ends: expected steps or until")
            if number == len(value) and stage.ends:
                raise ValueError(f"stage {number} is the last one, which lasts until the end: remove steps and until")
        return value

    @field_validator("exploiter")
    @classmethod
    def _differences_are_possible(cls, value: dict[str, Any]) -> dict[str, Any]:
        if fixed := sorted(FIXED_FOR_EXPLOITERS & value.keys()):
            raise ValueError(f"{', '.join(fixed)} cannot be set for exploiters only")
        return value

    @model_validator(mode="after")
    def _network_replaces_layers(self) -> Self:
        if self.network is not None:
            self.refuse(self.replaced_by_network, "network takes the place of {}: remove one of them")
        return self

    @property
    def entry_points(self) -> tuple[str, ...]:
        """The user's code that these settings name, apart from bots."""
        algorithm = (self.algorithm,) if ":" in self.algorithm else ()
        network = () if self.network is None else (self.network.entry_point,)
        wrappers = (wrapper.name for wrapper in self.wrappers if wrapper.is_own)
        trackers = (name for name in self.trackers if name not in TRACKERS)
        return (*algorithm, *network, *self.callbacks, *wrappers, *trackers)

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
