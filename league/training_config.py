"""The `training` section of a league's configuration: common settings and one class per algorithm."""

import math
from collections.abc import Mapping
from itertools import pairwise
from typing import Annotated, Any, Literal, NamedTuple, Self

from pydantic import AfterValidator, Discriminator, Field, Tag, model_validator

from league.environment_config import Part


class ConvolutionConfig(Part):
    """A convolution without padding over image-like observations."""

    filters: int = Field(ge=1)
    kernel: int = Field(default=3, ge=1)
    stride: int = Field(default=1, ge=1)


class RecurrenceConfig(Part):
    """An LSTM between the hidden layers and the heads (Hochreiter and Schmidhuber, 1997)."""

    width: int = Field(default=128, ge=1)
    sequence: int = Field(default=20, ge=1)
    """Steps of truncated backpropagation through time."""


class OpponentConfig(Part):
    """A fixed policy that controls the other sides in a fraction of the episodes and does not learn."""

    ref: str
    """A script (`script:random`), a version (`connect_four@3`), or an alias, which is resolved when training starts.
    `@3` and `@champion` refer to the league itself."""
    share: float = Field(gt=0, le=1)
    """Fraction of the episodes. The remaining episodes are self-play."""

    @model_validator(mode="before")
    @classmethod
    def _from_yaml(cls, value: Any) -> Any:
        return {"ref": value, "share": 1.0} if isinstance(value, str) else value


class PhaseConfig(Part):
    """A phase of training in which only some policies learn."""

    policies: tuple[str, ...] = Field(min_length=1)
    iterations: int = Field(ge=1)
    """Number of updates. The phases are repeated in order."""


class ScheduleProgress(NamedTuple):
    """How far training is."""

    steps: int
    """Actions of all agents, including those of parent versions."""
    budget: float
    """Fraction of the run's budget that is spent, 0 to 1."""


class AnnealingConfig(Part):
    """A schedule from `initial` to `final`."""

    schedule: Literal["linear", "cosine"] = "linear"
    """cosine: half a period, slow at both ends (Loshchilov and Hutter, 2017, arXiv 1608.03983, equation 5)."""
    initial: float = Field(ge=0)
    final: float = Field(ge=0)
    steps: int | None = Field(default=None, ge=1)
    """Number of actions of all agents, including those of parent versions; null: the budget of the run, of steps or of
    time, whichever is spent first."""

    def at(self, progress: ScheduleProgress) -> float:
        """Return the current value."""
        done = progress.budget if self.steps is None else min(progress.steps / self.steps, 1.0)
        share = (1 - math.cos(math.pi * done)) / 2 if self.schedule == "cosine" else done
        return (1 - share) * self.initial + share * self.final


Points = tuple[tuple[Annotated[int, Field(ge=0)], Annotated[float, Field(ge=0)]], ...]
"""A piecewise linear schedule: pairs of a number of actions, including those of parent versions, and a value. Constant
before the first and after the last pair."""


def _check_points(points: Points) -> Points:
    steps = [step for step, _ in points]
    if not steps or any(first >= second for first, second in pairwise(steps)):
        raise ValueError(f"expected [step, value] pairs with increasing steps, got {[list(pair) for pair in points]}")
    return points


def _schedule_form(value: Any) -> str:
    if isinstance(value, Mapping | AnnealingConfig):
        return "annealing"
    return "points" if isinstance(value, list | tuple) else "constant"


SCHEDULE_FORMS = ("annealing", "points", "constant")
"""Pydantic includes them in the paths of errors."""
_Annealing = Annotated[AnnealingConfig, Tag("annealing")]
_Points = Annotated[Points, AfterValidator(_check_points), Tag("points")]
Scheduled = Annotated[
    _Annealing | _Points | Annotated[float, Field(ge=0), Tag("constant")], Discriminator(_schedule_form)
]
"""A number, or a schedule of it."""
ScheduledPositive = Annotated[
    _Annealing | _Points | Annotated[float, Field(gt=0), Tag("constant")], Discriminator(_schedule_form)
]


def scheduled_value(value: Scheduled, progress: ScheduleProgress) -> float:
    """Return the current value of a setting that is a number or a schedule."""
    if isinstance(value, AnnealingConfig):
        return value.at(progress)
    if isinstance(value, tuple):
        return _interpolated(value, progress.steps)
    return value


def _interpolated(points: Points, steps: int) -> float:
    before = [point for point in points if point[0] <= steps]
    after = [point for point in points if point[0] > steps]
    if not before or not after:
        return (before[-1] if before else after[0])[1]
    (first, low), (second, high) = before[-1], after[0]
    share = (steps - first) / (second - first)
    return (1 - share) * low + share * high


class PolicySettings(Part):
    """Settings of PPO for one policy; null for the common value. See PPOConfig."""

    lr: ScheduledPositive | None = None
    gamma: float | None = Field(default=None, ge=0, le=1)
    lambda_: float | None = Field(default=None, ge=0, le=1, alias="lambda")
    clip: ScheduledPositive | None = None
    entropy: Scheduled | None = None


class TrainingSettings(Part):
    """Settings common to all algorithms."""

    seed: int = Field(default=0, ge=0)
    """Seed of the run, from which all random choices are derived."""
    steps: int = Field(default=1_000_000, ge=1)
    """Number of actions of all agents after which training ends."""
    minutes: float | None = Field(default=None, gt=0)
    """Wall-clock limit of training, in addition to `steps`."""
    checkpoint_every: int | None = Field(default=200_000, ge=1)
    """Number of actions between published versions; null disables this trigger. The end of training also publishes."""
    checkpoint_minutes: float | None = Field(default=None, gt=0)
    """Wall-clock minutes between published versions; the earlier of the two triggers applies."""
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
    """Convolutions for image-like parts of the observation, (height, width, channels). Other parts are flattened."""
    hidden: tuple[int, ...] = Field(default=(256, 256), min_length=1)
    """Widths of the hidden layers."""
    normalize_observations: bool = False
    """Normalize each observation feature by its running mean and standard deviation, inside the exported graph."""
    policies_to_train: tuple[str, ...] | tuple[PhaseConfig, ...] | None = None
    """The policies that learn, or repeated phases; null for all. Other policies keep their weights: those of the parent
    version (`--from`), or their initial weights."""
    opponents: tuple[OpponentConfig, ...] = ()
    """Fixed opponents. In their episodes one random side learns, and the opponent controls all others."""
    gpus: float = Field(default=0, ge=0)
    """GPUs of the learner; a fraction shares a GPU."""
    runner_gpus: float = Field(default=0, ge=0)
    """GPUs of each runner for inference."""
    crashes: int = Field(default=3, ge=0)
    """Maximum number of consecutive exceptions after which an environment is recreated; the next one ends training."""
    opening_plies: int = Field(default=0, ge=0)
    """Maximum number of random legal moves at the start of each episode. They are excluded from training and lead to
    positions that self-play alone would not visit."""

    @model_validator(mode="after")
    def _shares_fit(self) -> Self:
        if (total := sum(opponent.share for opponent in self.opponents)) > 1 + 1e-9:
            raise ValueError(f"the shares of opponents must sum to at most 1, got {total:g}")
        return self

    def budget_spent(self, steps: int, seconds: float) -> float:
        """Return the fraction of the budget that a run has spent, of steps or of time, whichever is larger; at most 1.

        Args:
            steps: Actions of the run, without those of parent versions.
            seconds: Training time of the run.
        """
        of_time = seconds / (60 * self.minutes) if self.minutes is not None else 0.0
        return min(max(steps / self.steps, of_time), 1.0)


class PPOConfig(TrainingSettings):
    """Proximal policy optimisation (Schulman et al., 2017, arXiv 1707.06347)."""

    algorithm: Literal["ppo"] = "ppo"
    lr: ScheduledPositive = 5e-4
    """Learning rate of Adam."""
    train_batch_size: int = Field(default=4096, ge=1)
    """Actions per update."""
    minibatch_size: int = Field(default=512, ge=1)
    """Actions per gradient step."""
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
    recurrence: RecurrenceConfig | None = None
    """Recurrent layer; null for none."""
    shared_encoder: bool = False
    """Share the convolutions and hidden layers among all policies. Heads are separate."""
    per_policy: dict[str, PolicySettings] = Field(default={})
    """Policy id → settings that differ from the common ones."""

    @model_validator(mode="after")
    def _minibatch_fits(self) -> Self:
        if self.minibatch_size > self.train_batch_size:
            raise ValueError(f"minibatch_size must be at most train_batch_size ({self.train_batch_size})")
        return self

    @model_validator(mode="after")
    def _encoder_fits(self) -> Self:
        if self.shared_encoder and self.recurrence is not None:
            raise ValueError("shared_encoder does not support recurrence")
        return self


class PrioritiesConfig(Part):
    """Prioritised experience replay (Schaul et al., 2016, arXiv 1511.05952)."""

    alpha: float = Field(default=0.6, gt=0, le=1)
    """Sampling probabilities are proportional to |TD error|^α."""
    beta: float = Field(default=0.4, ge=0, le=1)
    """Initial exponent of the importance weights; it increases to 1 until the end of training."""


class ExplorationConfig(Part):
    """Linear exploration schedule from `initial` to `final` over `steps` actions."""

    initial: float = Field(default=1.0, ge=0)
    final: float = Field(default=0.05, ge=0)
    steps: int = Field(default=100_000, ge=1)
    """Number of actions of all agents, including those of parent versions."""

    def at(self, steps: int) -> float:
        """Return the value after a number of actions."""
        return self.initial + (self.final - self.initial) * min(steps / self.steps, 1.0)


class OffPolicyConfig(TrainingSettings):
    """Settings common to algorithms with a replay buffer."""

    lr: float = Field(default=3e-4, gt=0)
    """Learning rate of Adam."""
    grad_clip: float = Field(default=10.0, gt=0)
    replay_capacity: int = Field(default=100_000, ge=1)
    """Capacity of the replay buffer: transitions of each policy, or joint transitions of all agents."""
    replay_in_checkpoint: bool = True
    """Whether checkpoints include the replay buffer. Without it, resumed training starts with an empty buffer and
    differs from uninterrupted training."""
    learning_starts: int = Field(default=1_000, ge=1)
    """Number of transitions in the buffer at which learning starts."""
    batch_size: int = Field(default=256, ge=1)
    """Transitions per gradient step."""
    update_every: int = Field(default=64, ge=1)
    """Actions of all agents between two rounds of learning; at least one per environment."""
    updates: int = Field(default=4, ge=1)
    """Gradient steps per round."""
    target_every: int = Field(default=500, ge=1)
    """Gradient steps between updates of the target networks."""
    target_rate: float = Field(default=1.0, gt=0, le=1)
    """Interpolation factor of target updates: 1 copies the weights; smaller values are Polyak averaging."""
    n_step: int = Field(default=1, ge=1)
    """Steps of n-step returns; fewer at the end of an episode."""
    exploration: ExplorationConfig = ExplorationConfig()
    priorities: PrioritiesConfig | None = None
    """Prioritised replay; null for uniform sampling."""

    @model_validator(mode="after")
    def _buffer_fits(self) -> Self:
        if self.learning_starts > self.replay_capacity:
            raise ValueError(f"learning_starts must be at most replay_capacity ({self.replay_capacity})")
        return self


class QLearningConfig(OffPolicyConfig):
    """Settings common to algorithms with action values."""

    double: bool = True
    """Double Q-learning: the online network selects the next action and the target network evaluates it (van Hasselt,
    Guez and Silver, 2016, arXiv 1509.06461)."""

    @model_validator(mode="after")
    def _probabilities(self) -> Self:
        if max(self.exploration.initial, self.exploration.final) > 1:
            raise ValueError("exploration: initial and final are probabilities of a random action, at most 1")
        return self


class DistributionalConfig(Part):
    """Categorical value distributions, C51 (Bellemare, Dabney and Munos, 2017, arXiv 1707.06887)."""

    atoms: int = Field(default=51, ge=2)
    """Number of atoms."""
    low: float
    """Return of the first atom."""
    high: float
    """Return of the last atom."""

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if not self.low < self.high:
            raise ValueError(f"high must be greater than low ({self.low:g})")
        return self


class DQNConfig(QLearningConfig):
    """Deep Q-learning with action masks (Mnih et al., 2015, Nature 518)."""

    algorithm: Literal["dqn"]
    dueling: bool = True
    """Separate heads for state values and advantages (Wang et al., 2016, arXiv 1511.06581)."""
    noisy: bool = False
    """Noisy heads, in addition to ε-greedy exploration (Fortunato et al., 2018, arXiv 1706.10295)."""
    distributional: DistributionalConfig | None = None
    """Value distributions; null for expected values."""


class GatedRecurrenceConfig(Part):
    """A GRU before the head (Cho et al., 2014, arXiv 1406.1078), whose input includes the previous action."""

    width: int = Field(default=64, ge=1)
    sequence: int = Field(default=50, ge=1)
    """Length of training sequences. Longer episodes are split at its multiples; each part starts from the recurrent
    state recorded during sampling."""


class QMIXConfig(QLearningConfig):
    """QMIX: agents' values mixed to a team value (Rashid et al., 2018, arXiv 1803.11485)."""

    algorithm: Literal["qmix"]
    mixer: Literal["qmix", "vdn", "none"] = "qmix"
    """qmix: a monotonic network conditioned on the global state. vdn: the sum (Sunehag et al., 2017, arXiv 1706.05296).
    none: independent learning from each agent's own rewards."""
    mixing_width: int = Field(default=32, ge=1)
    """Width of the mixing network's hidden layer."""
    groups: dict[str, tuple[str, ...]] | None = None
    """Group → agents whose values are mixed, as names or patterns; null for the league's sides."""
    recurrence: GatedRecurrenceConfig | None = None
    """Recurrent layer; null for none. With it, `batch_size` counts sequences."""

    @model_validator(mode="after")
    def _sequences_fit(self) -> Self:
        if self.recurrence is not None and (self.n_step > 1 or self.priorities is not None):
            raise ValueError("recurrence requires n_step 1 and no priorities")
        return self


class MADDPGConfig(OffPolicyConfig):
    """MADDPG (Lowe et al., 2017, arXiv 1706.02275).

    Defaults are those of the authors' implementation (openai/maddpg), converted from steps of an environment with three
    agents to actions.
    """

    algorithm: Literal["maddpg"]
    lr: float = Field(default=0.01, gt=0)
    gamma: float = Field(default=0.95, ge=0, le=1)
    grad_clip: float = Field(default=0.5, gt=0)
    hidden: tuple[int, ...] = Field(default=(64, 64), min_length=1)
    """Widths of the hidden layers of actors and critics."""
    replay_capacity: int = Field(default=1_000_000, ge=1)
    learning_starts: int = Field(default=25_600, ge=1)
    batch_size: int = Field(default=1024, ge=1)
    """Transitions per gradient step of each policy; every policy samples its own batch."""
    update_every: int = Field(default=300, ge=1)
    updates: int = Field(default=1, ge=1)
    target_every: int = Field(default=1, ge=1)
    target_rate: float = Field(default=0.01, gt=0, le=1)
    exploration: ExplorationConfig = ExplorationConfig(initial=0.3, final=0.1, steps=1_000_000)
    """Standard deviation of the noise on Box actions scaled to [-1, 1]. Discrete actions are sampled from their logits
    without additional noise."""
    critic: Literal["centralised", "own"] = "centralised"
    """Input of critics: observations and actions of all agents, or those of their own agent (DDPG)."""
    temperature: float = Field(default=1.0, gt=0)
    """Temperature of the Gumbel-softmax for gradients through discrete actions."""
    regularization: float = Field(default=0.001, ge=0)
    """Coefficient of the mean squared actor output, before masks and bounds, in the actor loss."""
    theta: float | None = Field(default=None, gt=0, le=1)
    """Mean-reversion rate of Ornstein-Uhlenbeck noise (0.15 in the DDPG paper); null for independent noise."""


# A new algorithm needs a class above and an entry in each of the three definitions below.

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
