"""The settings of training: what all algorithms share, then those of each one."""

from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self

from pydantic import Discriminator, Field, Tag, model_validator

from league.parts import Part


class ConvolutionConfig(Part):
    """One convolution over the planes of an observation, without padding."""

    filters: int = Field(ge=1)
    kernel: int = Field(default=3, ge=1)
    stride: int = Field(default=1, ge=1)


class RecurrenceConfig(Part):
    """A long short-term memory between the hidden layers and the heads (Hochreiter and Schmidhuber, 1997)."""

    width: int = Field(default=128, ge=1)
    sequence: int = Field(default=20, ge=1)
    """Steps through which gradients flow back."""


class OpponentConfig(Part):
    """Somebody who plays the other sides in a share of the episodes, and does not learn."""

    ref: str
    """A script (`script:random`), a version (`connect_four@3`), or an alias, which is pinned when training begins;
    `@3` and `@champion` are short for those of the league itself."""
    share: float = Field(gt=0, le=1)
    """Of the episodes. What is left of 1 is self-play."""

    @model_validator(mode="before")
    @classmethod
    def _from_yaml(cls, value: Any) -> Any:
        return {"ref": value, "share": 1.0} if isinstance(value, str) else value


class PhaseConfig(Part):
    """A part of training in which some policies learn and the others stay as they are."""

    policies: tuple[str, ...] = Field(min_length=1)
    iterations: int = Field(ge=1)
    """Updates until the next phase; after the last one the first follows again."""


class PolicySettings(Part):
    """Settings of one policy that differ from the league's. See PPOConfig."""

    lr: float | None = Field(default=None, gt=0)
    gamma: float | None = Field(default=None, ge=0, le=1)
    lambda_: float | None = Field(default=None, ge=0, le=1, alias="lambda")
    clip: float | None = Field(default=None, gt=0)
    entropy: float | None = Field(default=None, ge=0)


class TrainingSettings(Part):
    """What is set alike for every algorithm."""

    seed: int = Field(default=0, ge=0)
    steps: int = Field(default=1_000_000, ge=1)
    """Actions of all agents after which training ends."""
    minutes: float | None = Field(default=None, gt=0)
    """Wall-clock limit of training; it ends at whichever of the two limits comes first."""
    checkpoint_every: int | None = Field(default=200_000, ge=1)
    """Actions between two published versions, null for no such cadence. The end of training publishes one too."""
    checkpoint_minutes: float | None = Field(default=None, gt=0)
    """Wall-clock minutes of training between two published versions; the sooner of the two counts."""
    runners: int = Field(default=1, ge=0)
    """Sampling processes; 0 samples in the learner's process."""
    copies: int = Field(default=32, ge=1)
    """Environment copies stepped together in each runner."""
    lr: float = Field(default=3e-4, gt=0)
    gamma: float = Field(default=0.99, ge=0, le=1)
    grad_clip: float = Field(default=0.5, gt=0)
    convolutions: tuple[ConvolutionConfig, ...] = ()
    """Layers over those parts of the observation that are planes, (height, width, channels). Others are flattened."""
    hidden: tuple[int, ...] = Field(default=(256, 256), min_length=1)
    """Widths of the hidden layers."""
    normalize_observations: bool = False
    """Shift and scale each number of the observations by its running mean and deviation, inside the exported graph."""
    policies_to_train: tuple[str, ...] | tuple[PhaseConfig, ...] | None = None
    """The policies that learn, or phases that follow one another in a circle; null for all. The others play on with the
    weights that they have: those of the version that training began from (`--from`), else their initial ones."""
    opponents: tuple[OpponentConfig, ...] = ()
    """Who plays against the learners in some episodes: one side, drawn anew in each, learns, and the opponent has all
    others."""
    gpus: float = Field(default=0, ge=0)
    """GPUs of the learner; a fraction shares one."""
    runner_gpus: float = Field(default=0, ge=0)
    """GPUs of each runner, for its inference."""
    crashes: int = Field(default=3, ge=0)
    """Times in a row that a copy of the environment may raise and is built anew; its episode is not learned from."""
    opening_plies: int = Field(default=0, ge=0)
    """Up to this many random legal moves begin each episode. They are not learned from, but lead to positions that
    self-play alone would not visit."""

    @model_validator(mode="after")
    def _shares_fit(self) -> Self:
        if (total := sum(opponent.share for opponent in self.opponents)) > 1 + 1e-9:
            raise ValueError(f"the shares of opponents must not exceed 1, got {total:g}")
        return self


class PPOConfig(TrainingSettings):
    """Proximal policy optimisation by self-play (Schulman et al., 2017, arXiv 1707.06347)."""

    algorithm: Literal["ppo"] = "ppo"
    train_batch_size: int = Field(default=2048, ge=1)
    """Actions per update."""
    minibatch_size: int = Field(default=256, ge=1)
    epochs: int = Field(default=4, ge=1)
    lambda_: float = Field(default=0.95, ge=0, le=1, alias="lambda")
    clip: float = Field(default=0.2, gt=0)
    entropy: float = Field(default=0.05, ge=0)
    value_loss: float = Field(default=0.5, ge=0)
    recurrence: RecurrenceConfig | None = None
    """A memory over the steps of an episode, null for none."""
    shared_encoder: bool = False
    """All policies share the convolutions and hidden layers, each has heads of its own."""
    per_policy: dict[str, PolicySettings] = Field(default={})
    """policy id → settings that differ for it."""

    @model_validator(mode="after")
    def _minibatch_fits(self) -> Self:
        if self.minibatch_size > self.train_batch_size:
            raise ValueError(f"minibatch_size must be at most train_batch_size ({self.train_batch_size})")
        return self

    @model_validator(mode="after")
    def _encoder_fits(self) -> Self:
        if self.shared_encoder and self.recurrence is not None:
            raise ValueError("shared_encoder has no memory: leave recurrence out")
        return self


class PrioritiesConfig(Part):
    """Transitions with large errors are sampled more often (Schaul et al., 2016, arXiv 1511.05952)."""

    alpha: float = Field(default=0.6, gt=0, le=1)
    """How much more: probabilities are proportional to |error|^α."""
    beta: float = Field(default=0.4, ge=0, le=1)
    """How far the importance weights make up for it at the beginning; at the end of training wholly."""


class ExplorationConfig(Part):
    """How much is explored: from `initial` to `final` in a straight line over `steps` actions."""

    initial: float = Field(default=1.0, ge=0)
    final: float = Field(default=0.05, ge=0)
    steps: int = Field(default=100_000, ge=1)
    """Actions of all agents, those of the versions that training began from included."""

    def at(self, steps: int) -> float:
        """After so many actions."""
        return self.initial + (self.final - self.initial) * min(steps / self.steps, 1.0)


class OffPolicyConfig(TrainingSettings):
    """What algorithms share that learn from a replay buffer."""

    grad_clip: float = Field(default=10.0, gt=0)
    replay_capacity: int = Field(default=100_000, ge=1)
    """Transitions that are kept, the newest: of each policy, or joint ones of all agents."""
    replay_in_checkpoint: bool = True
    """Whether versions carry the buffer along. Without, training that goes on from one begins with an empty buffer, and
    differs from a training that was not interrupted."""
    learning_starts: int = Field(default=1_000, ge=1)
    """Transitions in the buffer before which nothing is learned."""
    batch_size: int = Field(default=256, ge=1)
    """Transitions per gradient step."""
    update_every: int = Field(default=64, ge=1)
    """Actions of all agents between two rounds of learning; at least one of each copy is taken."""
    updates: int = Field(default=4, ge=1)
    """Gradient steps per round."""
    target_every: int = Field(default=500, ge=1)
    """Gradient steps between two updates of the target networks."""
    target_rate: float = Field(default=1.0, gt=0, le=1)
    """How far the target networks then move to the networks that learn: 1 copies them, less is Polyak's average."""
    n_step: int = Field(default=1, ge=1)
    """Steps whose rewards are summed before the value of what follows is estimated; fewer where an episode ends."""
    exploration: ExplorationConfig = ExplorationConfig()
    priorities: PrioritiesConfig | None = None
    """Prioritised replay, null for uniform."""

    @model_validator(mode="after")
    def _buffer_fits(self) -> Self:
        if self.learning_starts > self.replay_capacity:
            raise ValueError(f"learning_starts must be at most replay_capacity ({self.replay_capacity})")
        return self


class QLearningConfig(OffPolicyConfig):
    """What algorithms share that choose the action of the largest value."""

    double: bool = True
    """The network that learns chooses the next action, the target network values it (van Hasselt, Guez and Silver,
    2016, arXiv 1509.06461)."""

    @model_validator(mode="after")
    def _probabilities(self) -> Self:
        if max(self.exploration.initial, self.exploration.final) > 1:
            raise ValueError("exploration: initial and final are probabilities of a random action, at most 1")
        return self


class DistributionalConfig(Part):
    """Values as distributions over atoms: C51 (Bellemare, Dabney and Munos, 2017, arXiv 1707.06887)."""

    atoms: int = Field(default=51, ge=2)
    low: float
    """Smallest return that an atom stands for."""
    high: float

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if not self.low < self.high:
            raise ValueError(f"high must be greater than low ({self.low:g})")
        return self


class DQNConfig(QLearningConfig):
    """Deep Q-learning with action masks (Mnih et al., 2015, Nature 518)."""

    algorithm: Literal["dqn"]
    dueling: bool = True
    """Values of states and advantages of actions have heads of their own (Wang et al., 2016, arXiv 1511.06581)."""
    noisy: bool = False
    """Explore by noise in the weights of the heads, too (Fortunato et al., 2018, arXiv 1706.10295)."""
    distributional: DistributionalConfig | None = None


class GatedRecurrenceConfig(Part):
    """A gated recurrent unit before the head (Cho et al., 2014, arXiv 1406.1078), which also reads the last action."""

    width: int = Field(default=64, ge=1)
    sequence: int = Field(default=50, ge=1)
    """Steps that are learned from together. Episodes up to this length are learned from whole; of longer ones, parts
    that begin at its multiples, with what was remembered there when they were played."""


class QMIXConfig(QLearningConfig):
    """Values of actions that are mixed to a value of the team's (Rashid et al., 2018, arXiv 1803.11485)."""

    algorithm: Literal["qmix"]
    mixer: Literal["qmix", "vdn", "none"] = "qmix"
    """How: by a monotonic network that the global state decides, by their sum (Sunehag et al., 2017, arXiv 1706.05296),
    or not at all: each agent then learns by itself, from its own rewards."""
    mixing_width: int = Field(default=32, ge=1)
    """Of the hidden layer of the mixing network."""
    groups: dict[str, tuple[str, ...]] | None = None
    """Group → the agents whose values are mixed, as names or patterns; null: the league's sides."""
    recurrence: GatedRecurrenceConfig | None = None
    """A memory over the steps of an episode, null for none. Transitions of `batch_size` are then sequences."""

    @model_validator(mode="after")
    def _sequences_fit(self) -> Self:
        if self.recurrence is not None and (self.n_step > 1 or self.priorities is not None):
            raise ValueError("recurrence learns from whole sequences: leave n_step at 1 and priorities out")
        return self


class MADDPGConfig(OffPolicyConfig):
    """Actors with critics that see all agents (Lowe et al., 2017, arXiv 1706.02275), with the settings of the authors'
    implementation (openai/maddpg), which counts steps of an environment of three agents."""

    algorithm: Literal["maddpg"]
    lr: float = Field(default=0.01, gt=0)
    gamma: float = Field(default=0.95, ge=0, le=1)
    grad_clip: float = Field(default=0.5, gt=0)
    hidden: tuple[int, ...] = Field(default=(64, 64), min_length=1)
    """Widths of the hidden layers, of actors and critics."""
    replay_capacity: int = Field(default=1_000_000, ge=1)
    learning_starts: int = Field(default=25_600, ge=1)
    batch_size: int = Field(default=1024, ge=1)
    """Transitions of each policy's step, which draws its own."""
    update_every: int = Field(default=300, ge=1)
    updates: int = Field(default=1, ge=1)
    target_every: int = Field(default=1, ge=1)
    target_rate: float = Field(default=0.01, gt=0, le=1)
    exploration: ExplorationConfig = ExplorationConfig(initial=0.3, final=0.1, steps=1_000_000)
    """Deviation of the noise on the actions of a Box, whose bounds are -1 and 1 for it. Choices are drawn at random by
    their logits, and take none."""
    critic: Literal["centralised", "own"] = "centralised"
    """What critics see: all agents' observations and actions, or their own agent's alone, which is DDPG."""
    temperature: float = Field(default=1.0, gt=0)
    """Of the Gumbel-softmax that gradients pass through to choices."""
    regularization: float = Field(default=0.001, ge=0)
    """How much the squares of the actors' answers, before masks and bounds, add to their loss."""
    theta: float | None = Field(default=None, gt=0, le=1)
    """Let the noise be an Ornstein-Uhlenbeck process that returns to 0 at this rate (0.15 in the DDPG paper); null for
    independent noise."""


# Each algorithm: a class above, and a member of the three below.

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
"""The settings of one algorithm, told apart by `algorithm`."""
