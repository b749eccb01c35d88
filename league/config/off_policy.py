"""Settings of the algorithms with a replay buffer: DQN, QMIX and MADDPG."""

from typing import ClassVar, Literal, Self

from pydantic import Field, ValidationInfo, field_validator, model_validator

from league.config.base import Part
from league.config.network import GatedRecurrenceConfig
from league.config.training import TrainingSettings


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
    """Whether checkpoints include the replay buffer. Without it, or with another capacity than the version's, training
    that continues from a version starts with an empty buffer and differs from uninterrupted training."""
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

    @field_validator("learners", "batch_scale")
    @classmethod
    def _only_one(cls, value: int | str, info: ValidationInfo) -> int | str:
        if value not in (1, "auto"):
            ability = "supports several learners" if info.field_name == "learners" else "scales its batches"
            raise ValueError(f"expected 1, since only ppo {ability}; got {value}")
        return value

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
    recurrence: GatedRecurrenceConfig | None = None
    """Recurrent layer; null for none. With it, `batch_size` counts sequences."""

    @model_validator(mode="after")
    def _settings_fit(self) -> Self:
        if max(self.exploration.initial, self.exploration.final) > 1:
            raise ValueError("exploration: initial and final are probabilities of a random action, at most 1")
        if self.recurrence is not None and (self.n_step > 1 or self.priorities is not None):
            raise ValueError("recurrence requires n_step 1 and no priorities")
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

    dueling: bool = True
    """Separate heads for state values and advantages (Wang et al., 2016, arXiv 1511.06581)."""
    noisy: bool = False
    """Noisy heads, in addition to ε-greedy exploration (Fortunato et al., 2018, arXiv 1706.10295)."""
    distributional: DistributionalConfig | None = None
    """Value distributions; null for expected values."""


class QMIXConfig(QLearningConfig):
    """QMIX: agents' values mixed to a team value (Rashid et al., 2018, arXiv 1803.11485)."""

    mixer: Literal["qmix", "vdn", "none"] = "qmix"
    """qmix: a monotonic network conditioned on the global state. vdn: the sum (Sunehag et al., 2017, arXiv 1706.05296).
    none: independent learning from each agent's own rewards."""
    mixing_width: int = Field(default=32, ge=1)
    """Width of the mixing network's hidden layer."""
    groups: dict[str, tuple[str, ...]] | None = None
    """Group → agents whose values are mixed, as names or patterns; null for the league's sides."""


class MADDPGConfig(OffPolicyConfig):
    """MADDPG (Lowe et al., 2017, arXiv 1706.02275).

    Defaults are those of the authors' implementation (openai/maddpg), converted from steps of an environment with three
    agents to actions.
    """

    supports_opponents: ClassVar[bool] = False
    """Critics need the observations and actions of all agents."""
    replaced_by_network: ClassVar[tuple[str, ...]] = ()
    """They are settings of the critics, too."""
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
