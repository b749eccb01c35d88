"""A league, whole, in one YAML file: environment, policies, sides, play, training and gate.

Unknown keys are refused, everything is frozen, and an error names the file, the key and what was expected.
"""

import difflib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, Self, get_args, get_origin

import yaml
from pydantic import BaseModel, Field, ValidationError, field_validator, model_validator

from league.errors import ConfigError, InvalidReference
from league.interface import digest
from league.parts import Part
from league.refs import check_slug
from league.training_config import ALGORITHMS, PPOConfig, TrainingConfig

JSON = dict[str, Any]
ONE_POLICY: dict[str, tuple[str, ...]] = {"shared": ("*",)}


class WrapperConfig(Part):
    """One SuperSuit wrapper by name, `{name: {argument: value}}` in YAML, applied in the order of the list."""

    name: str
    kwargs: JSON = Field(default={})

    @model_validator(mode="before")
    @classmethod
    def _from_yaml(cls, value: Any) -> Any:
        if isinstance(value, str):
            return {"name": value}
        if isinstance(value, dict) and len(value) == 1 and "name" not in value:
            name, kwargs = next(iter(value.items()))
            return {"name": name, "kwargs": kwargs or {}}
        return value


class EnvironmentConfig(Part):
    """Which environment is played, and with which wrappers."""

    entry_point: str
    """A PettingZoo module (`pettingzoo.classic.connect_four_v3`) or a function (`package.module:function`)."""
    api: Literal["aec", "parallel", "rllib"] | None = None
    """PettingZoo's AEC or Parallel API, or RLlib's MultiAgentEnv. By default that of what a function returns; a module
    with `parallel_env` is taken as Parallel, one with `env` alone as AEC."""
    kwargs: JSON = Field(default={})
    """Arguments of the environment's constructor."""
    wrappers: tuple[WrapperConfig, ...] = ()

    def digest(self) -> str:
        """SHA-256 of the environment: results of environments with other digests are never mixed."""
        return digest(self.model_dump(mode="json"))


class PlayConfig(Part):
    """How matches are played."""

    opening_plies: int = Field(default=0, ge=0)
    """Random legal steps at the start of each game. A deterministic game between greedy policies needs some:
    without them it repeats one game for ever."""
    copies: int = Field(default=32, ge=1)
    """Games stepped together in one worker. Has no influence on any result."""
    max_moves: int = Field(default=10_000, ge=1)
    """Steps of the environment after which a game counts as hung and the match fails; where several agents act at once,
    their actions are one step."""
    game_seconds: float = Field(default=600.0, gt=0, allow_inf_nan=False)
    """Seconds of the environment's own work on one game after which it counts as hung, too: of its reset and its steps,
    and not of the other games that are stepped beside it."""


LARGEST_NORMALIZED_ELO = 190
"""Farther hypotheses have no usable test: see evaluation/sequential.py."""


class AnchorConfig(Part):
    """Somebody held out of training, to whom a challenger must not be inferior."""

    ref: str
    """A script (`script:one_ply`), a version (`connect_four@3`), or an alias, which is pinned when a verdict opens;
    `@3` and `@gold` are short for those of the league itself."""
    margin: float | None = Field(default=None, gt=0)
    """By how much it may be weaker; by default the gate's."""

    @model_validator(mode="before")
    @classmethod
    def _from_yaml(cls, value: Any) -> Any:
        return {"ref": value} if isinstance(value, str) else value


class GateConfig(Part):
    """What a challenger must show to be promoted. See docs/statistics.md."""

    model: Literal["logistic", "normalized", "returns"] = "normalized"
    """What a block counts: its score, in logistic or normalized Elo (GSPRT), or the difference of returns (betting)."""
    elo0: float = 0.0
    """H0: the challenger is this much stronger than the champion, in Elo of `model`."""
    elo1: float = 30.0
    """H1: the challenger is this much stronger."""
    return0: float = 0.0
    """H0 of the model `returns`: its mean return is at most this much greater."""
    return1: float = 0.0
    """H1 of the model `returns`: its mean return is at least this much greater."""
    return_bound: float | None = Field(default=None, gt=0)
    """No block's returns differ by more; `returns` needs it."""
    alpha: float = Field(default=0.05, gt=0, lt=0.5)
    """Probability of promoting any challenger under H0 in a year of nights."""
    nights: int | None = Field(default=365, ge=1)
    """Nights of a year, over which alpha is spent in equal parts; the candidates of a night share its part. Null: every
    verdict has all of alpha for itself."""
    beta: float = Field(default=0.05, gt=0, lt=0.5)
    """Probability of rejecting a challenger under H1."""
    max_blocks: int = Field(default=4000, ge=1)
    """Blocks of one test after which it is `inconclusive` and the champion stays."""
    anchors: tuple[AnchorConfig, ...] = ()
    """Those to whom a challenger must not be inferior, besides earlier champions."""
    earlier_champions: int = Field(default=2, ge=0)
    """How many champions before the present one are anchors, too."""
    margin: float = Field(default=50.0, gt=0)
    """How much weaker than an anchor a challenger may be, in Elo of `model`, or in returns."""
    confirmation_blocks: int = Field(default=200, ge=0)
    """Fresh blocks against the champion of before, played after a promotion: how much was really gained."""
    forfeits: bool = False
    """Whether a challenger may be promoted that forfeited a game, by an illegal action or a crash."""
    shadow_agreement: float | None = Field(default=None, ge=0, le=1)
    """Share of mirrored observations on which the challenger must act as the champion does; null asks for none. Like
    `latency_ms`, it applies where there is a champion, whose requests can be mirrored."""
    latency_ms: float | None = Field(default=None, gt=0)
    """Milliseconds of the processor within which the challenger must compute 95 % of mirrored requests."""
    shadow_observations: int = Field(default=1000, ge=1)
    """Mirrored observations without which those two are not known."""

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        margins = [self.margin, *(anchor.margin for anchor in self.anchors if anchor.margin is not None)]
        if self.model == "returns":
            self._check_returns(max(margins))
            return self
        if not self.elo0 < self.elo1:
            raise ValueError(f"elo1 must be greater than elo0 ({self.elo0:g})")
        if self.model == "normalized" and max(-self.elo0, self.elo1, *margins) > LARGEST_NORMALIZED_ELO:
            raise ValueError(
                f"elo0, elo1 and margins must lie within ±{LARGEST_NORMALIZED_ELO} (normalized Elo),"
                f" got {self.elo0:g}, {self.elo1:g} and {max(margins):g}"
            )
        return self

    def _check_returns(self, margin: float) -> None:
        if self.return_bound is None:
            raise ValueError("the model returns needs return_bound: by how much the returns of a block can differ")
        if not -self.return_bound < self.return0 <= self.return1 < self.return_bound:
            raise ValueError(
                f"return0 and return1 must lie within ±{self.return_bound:g} (return_bound), return0 first,"
                f" got {self.return0:g} and {self.return1:g}"
            )
        if margin >= self.return_bound:
            raise ValueError(f"margin must be smaller than return_bound ({self.return_bound:g}), got {margin:g}")

    def against_anchor(self, margin: float | None) -> Self:
        """The test of non-inferiority: H0 is being weaker by the margin, H1 being as strong."""
        below = -(self.margin if margin is None else margin)
        zero = {"return0": below, "return1": 0.0} if self.model == "returns" else {"elo0": below, "elo1": 0.0}
        return self.model_copy(update=zero)

    def of_one_verdict(self, alpha: float) -> Self:
        """The same for a verdict that spends this much of alpha."""
        return self.model_copy(update={"alpha": alpha, "nights": None})


class AshaConfig(Part):
    """Asynchronous successive halving: bad trials end early (Li et al., 2020, arXiv 1810.05934)."""

    grace_steps: int = Field(default=50_000, ge=1)
    """Actions that each trial gets."""
    reduction_factor: int = Field(default=3, ge=2)
    """One of this many trials goes on at each rung."""


class SweepConfig(Part):
    """A search over training settings: `league sweep`."""

    parameters: dict[str, JSON | list[Any]] = Field(min_length=1)
    """Training setting → a list of values (all are tried), or one of `{choice: [..]}`, `{uniform: [low, high]}`,
    `{loguniform: [low, high]}`, `{randint: [low, high]}`. A setting of one policy is `per_policy.<id>.<setting>`."""
    samples: int = Field(default=1, ge=1)
    """Draws of the random parameters, for each combination of the lists."""
    concurrent: int = Field(default=1, ge=1)
    """Trials at once, as far as there are CPUs."""
    metric: str = "return"
    """What is compared: a curve of the run, `return` or `<policy>/return`."""
    mode: Literal["max", "min"] = "max"
    asha: AshaConfig | None = None
    """End bad trials early; null lets each use its whole budget."""


class LeagueConfig(Part):
    """One league. Only `league` and `environment` are required."""

    league: str
    environment: EnvironmentConfig
    policies: dict[str, tuple[str, ...]] | str = Field(default=ONE_POLICY)
    """policy id → agents, by name or pattern (`player_*`); the first policy whose pattern fits takes the agent. Or a
    function `package.module:function`: agent → policy id."""
    sides: dict[str, tuple[str, ...]] | None = None
    """side → agents, by name or pattern; by default each agent is a side of its own."""
    play: PlayConfig = PlayConfig()
    training: TrainingConfig = PPOConfig()
    gate: GateConfig = GateConfig()
    sweep: SweepConfig | None = None

    @field_validator("league")
    @classmethod
    def _league_is_slug(cls, value: str) -> str:
        return _slug("league", value)

    @field_validator("policies", "sides")
    @classmethod
    def _keys_are_slugs(cls, value: dict[str, Any] | str | None) -> dict[str, Any] | str | None:
        if isinstance(value, str) and not all(part.strip() for part in value.partition(":")):
            raise ValueError("expected policy ids with their agents, or a function package.module:function")
        if isinstance(value, dict) and not value:
            raise ValueError("must name at least one")
        for key in value if isinstance(value, dict) else ():
            _slug("name", key)
        return value

    @classmethod
    def load(cls, path: Path | str) -> Self:
        """Read a league's file. Raises ConfigError."""
        try:
            document = yaml.safe_load(Path(path).read_text(encoding="utf-8"))
        except OSError as error:
            raise ConfigError(f"{path}: {error.strerror or error}") from error
        except (yaml.YAMLError, UnicodeDecodeError) as error:
            raise ConfigError(f"{path}: not a YAML file: {' '.join(str(error).split())}") from error
        return cls.from_mapping(document, source=str(path))

    @classmethod
    def from_mapping(cls, document: Any, source: str = "configuration") -> Self:
        """Check a league's settings. `source` names them in errors. Raises ConfigError."""
        if not isinstance(document, Mapping):
            raise ConfigError(f"{source}: expected keys such as 'league' and 'environment' at the top")
        try:
            return cls.model_validate(document)
        except ValidationError as error:
            raise ConfigError(f"{source}: {_sentence(cls, error)}") from error

    def with_training(self, **settings: Any) -> Self:
        """The same league with some training settings replaced, checked anew."""
        training = self.training.model_dump(by_alias=True) | settings
        return self.from_mapping(self.model_dump(by_alias=True) | {"training": training}, source=self.league)


def _slug(kind: str, value: str) -> str:
    try:
        return check_slug(kind, value)
    except InvalidReference as error:
        raise ValueError(str(error)) from error


def _sentence(model: type[BaseModel], error: ValidationError) -> str:
    """The first faults of a ValidationError in a person's words."""
    return "; ".join(_fault(model, detail) for detail in error.errors()[:3])


def _fault(model: type[BaseModel], detail: Any) -> str:
    path, known_by = [str(part) for part in detail["loc"]], model
    if path[:1] == ["training"] and len(path) > 1 and path[1] in ALGORITHMS:
        # Pydantic names the member of the union, too.
        known_by = ALGORITHMS[path.pop(1)]
    key = ".".join(path) or "file"
    match detail["type"]:
        case "missing":
            return f"{key}: missing, it is required"
        case "extra_forbidden":
            known = _known_keys(known_by, path[:-1] if known_by is model else path[1:-1])
            guess = difflib.get_close_matches(path[-1], known, n=1)
            hint = f"did you mean {guess[0]!r}?" if guess else f"expected one of {', '.join(sorted(known))}"
            return f"{key}: unknown key, {hint}"
        case "union_tag_invalid":
            return f"{key}.algorithm: expected one of {', '.join(ALGORITHMS)}, got {detail['ctx']['tag']!r}"
        case "value_error":
            return f"{key}: {detail['ctx']['error']}"
    expected = detail["msg"][0].lower() + detail["msg"][1:]
    return f"{key}: {expected}, got {detail['input']!r}"


def _known_keys(model: type[BaseModel], path: list[str]) -> list[str]:
    for part in path:
        if part.isdigit():
            continue  # a place in a list, whose members are of the model already
        fields = {field.alias or name: field for name, field in model.model_fields.items()}
        annotation = fields[part].annotation if part in fields else None
        while get_origin(annotation) is not None and get_args(annotation):
            annotation = get_args(annotation)[0]
        if not (isinstance(annotation, type) and issubclass(annotation, BaseModel)):
            return []
        model = annotation
    return [field.alias or name for name, field in model.model_fields.items()]
