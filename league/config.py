"""Configuration of a league, read from one YAML file: environment, policies, sides, matches, training and gate.

All models are frozen and reject unknown keys. Errors name the file, the key and the expected value.
"""

import difflib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self, get_args, get_origin

import yaml
from pydantic import BaseModel, Field, ValidationError, field_validator, model_validator

from league.environment_config import JSON, EnvironmentConfig, Part
from league.errors import ConfigError, InvalidReference, one_line
from league.refs import check_slug
from league.training_config import ALGORITHMS, SCHEDULE_FORMS, PPOConfig, TrainingConfig

RENAMED_KEYS = {"copies": "num_envs"}
"""Former key → current key."""
ONE_POLICY: dict[str, tuple[str, ...]] = {"shared": ("*",)}


class PlayConfig(Part):
    """Settings of matches."""

    opening_plies: int = Field(default=0, ge=0)
    """Random legal steps at the start of each game. Without them, greedy policies repeat one game of a deterministic
    environment."""
    scoring: Literal["game", "side"] | None = None
    """What a contestant's return is compared with. game: the returns of its opponents in the same game. side: the
    return of the other contestant on the same side in the block's other game. By default `game` if there are several
    equivalent sides, else `side`."""
    num_envs: Annotated[int, Field(ge=1)] | Literal["auto"] = "auto"
    """Games stepped in parallel in one worker. auto: 512 in a vectorised environment, else 32. Does not influence
    results."""
    max_moves: int = Field(default=10_000, ge=1)
    """Environment steps after which a game counts as hung and its match fails. Simultaneous actions of several agents
    are one step."""
    game_seconds: float = Field(default=600.0, gt=0, allow_inf_nan=False)
    """Seconds of environment time (resets and steps of this game alone) after which a game counts as hung."""


MAX_NORMALIZED_ELO = 190
"""Bound for hypotheses with a usable test; see evaluation/statistics/sequential.py."""


class AnchorConfig(Part):
    """An opponent for the non-inferiority test of a candidate."""

    ref: str
    """A script (`script:one_ply`), a version (`connect_four@3`), or an alias, which is resolved when the verdict is
    opened. `@3` and `@gold` refer to the league itself."""
    margin: float | None = Field(default=None, gt=0)
    """Non-inferiority margin; by default the gate's `margin`."""

    @model_validator(mode="before")
    @classmethod
    def _from_yaml(cls, value: Any) -> Any:
        return {"ref": value} if isinstance(value, str) else value


class GateConfig(Part):
    """The statistical test for promotions. See docs/statistics.md."""

    model: Literal["logistic", "normalized", "returns"] = "normalized"
    """The observed quantity of a block: its score in logistic or normalized Elo (GSPRT), or its difference of returns
    (test by betting)."""
    elo0: float = 0.0
    """H0: strength of the candidate relative to the champion, in Elo of `model`."""
    elo1: float = 30.0
    """H1: strength of the candidate relative to the champion."""
    return0: float = 0.0
    """H0 of the model `returns`: upper bound of the mean difference of returns."""
    return1: float = 0.0
    """H1 of the model `returns`: lower bound of the mean difference of returns."""
    return_bound: float | None = Field(default=None, gt=0)
    """Maximum absolute difference of returns in a block. Required by the model `returns`."""
    alpha: float = Field(default=0.05, gt=0, lt=0.5)
    """Probability of promoting at least one candidate under H0 in a year of nightly runs."""
    nights: int | None = Field(default=365, ge=1)
    """Nightly runs per year, among which alpha is divided equally; the candidates of a run share its part. Null: each
    verdict uses the full alpha."""
    beta: float = Field(default=0.05, gt=0, lt=0.5)
    """Probability of rejecting a candidate under H1."""
    max_blocks: int = Field(default=4000, ge=1)
    """Blocks after which a test ends as `inconclusive` and the champion stays."""
    anchors: tuple[AnchorConfig, ...] = ()
    """Opponents of non-inferiority tests, in addition to previous champions."""
    earlier_champions: int = Field(default=2, ge=0)
    """Number of previous champions that are anchors."""
    margin: float = Field(default=50.0, gt=0)
    """Non-inferiority margin, in Elo of `model` or in returns."""
    confirmation_blocks: int = Field(default=200, ge=0)
    """Blocks against the previous champion after a promotion, for an unbiased estimate of the improvement."""
    forfeits: bool = False
    """Whether a candidate that forfeited a game (illegal action or crash) may be promoted."""
    shadow_agreement: float | None = Field(default=None, ge=0, le=1)
    """Minimum fraction of mirrored observations for which candidate and champion choose the same action; null for no
    minimum. Like `latency_ms`, it applies only if the league has a champion."""
    latency_ms: float | None = Field(default=None, gt=0)
    """Maximum of the 95th percentile of the candidate's CPU time per mirrored request, in milliseconds."""
    shadow_observations: int = Field(default=1000, ge=1)
    """Minimum number of mirrored observations for these two criteria."""

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        margins = [self.margin, *(anchor.margin for anchor in self.anchors if anchor.margin is not None)]
        if self.model == "returns":
            self._check_returns(max(margins))
            return self
        if not self.elo0 < self.elo1:
            raise ValueError(f"elo1 must be greater than elo0 ({self.elo0:g})")
        if self.model == "normalized" and max(-self.elo0, self.elo1, *margins) > MAX_NORMALIZED_ELO:
            raise ValueError(
                f"elo0, elo1 and margins must lie within ±{MAX_NORMALIZED_ELO} (normalized Elo),"
                f" got {self.elo0:g}, {self.elo1:g} and {max(margins):g}"
            )
        return self

    def _check_returns(self, margin: float) -> None:
        if self.return_bound is None:
            raise ValueError("model: returns requires return_bound, the maximum difference of returns in a block")
        if not -self.return_bound < self.return0 <= self.return1 < self.return_bound:
            raise ValueError(
                f"return0 and return1 must lie within ±{self.return_bound:g} (return_bound), return0 first,"
                f" got {self.return0:g} and {self.return1:g}"
            )
        if margin >= self.return_bound:
            raise ValueError(f"margin must be smaller than return_bound ({self.return_bound:g}), got {margin:g}")

    def against_anchor(self, margin: float | None) -> Self:
        """Return the settings of a non-inferiority test. H0: weaker by the margin; H1: equally strong."""
        below = -(self.margin if margin is None else margin)
        zero = {"return0": below, "return1": 0.0} if self.model == "returns" else {"elo0": below, "elo1": 0.0}
        return self.model_copy(update=zero)

    def of_one_verdict(self, alpha: float) -> Self:
        """Return the settings of one verdict with error probability `alpha`."""
        return self.model_copy(update={"alpha": alpha, "nights": None})


class AshaConfig(Part):
    """Early stopping by asynchronous successive halving (Li et al., 2020, arXiv 1810.05934)."""

    grace_steps: int = Field(default=50_000, ge=1)
    """Minimum number of actions per trial."""
    reduction_factor: int = Field(default=3, ge=2)
    """At each rung, one in this many trials continues."""


class SweepConfig(Part):
    """Search over training settings (`league sweep`)."""

    parameters: dict[str, JSON | list[Any]] = Field(min_length=1)
    """Training setting → a list of values (grid search), or a distribution: `{choice: [..]}`, `{uniform: [low, high]}`,
    `{loguniform: [low, high]}`, `{randint: [low, high]}`. Settings of one policy are `per_policy.<id>.<setting>`."""
    samples: int = Field(default=1, ge=1)
    """Samples of the random parameters for each combination of the lists."""
    concurrent: int = Field(default=1, ge=1)
    """Maximum number of concurrent trials, also limited by the CPUs."""
    metric: str = "return"
    """Metric of the run by which trials are compared, such as `return` or `<policy>/return`."""
    mode: Literal["max", "min"] = "max"
    asha: AshaConfig | None = None
    """Early stopping; null trains each trial to its full budget."""


class LeagueConfig(Part):
    """Configuration of a league. Only `league` and `environment` are required."""

    league: str
    """Name of the league: a-z, 0-9, `_` and `-`."""
    environment: EnvironmentConfig
    policies: dict[str, tuple[str, ...]] | str = Field(default=ONE_POLICY)
    """Policy id → agents, by name or pattern (`player_*`); the first match determines an agent's policy. Alternatively
    a function `package.module:function` from agent to policy id."""
    sides: dict[str, tuple[str, ...]] | None = None
    """Side → agents, by name or pattern. By default each agent is a separate side."""
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
            raise ValueError("expected at least one entry")
        for key in value if isinstance(value, dict) else ():
            _slug("name", key)
        return value

    @classmethod
    def load(cls, path: Path | str) -> Self:
        """Read a YAML file. Raises ConfigError if it cannot be read, or the configuration is invalid."""
        try:
            document = yaml.safe_load(Path(path).read_text(encoding="utf-8"))
        except OSError as error:
            raise ConfigError(f"{path}: {error.strerror or error}") from error
        except (yaml.YAMLError, UnicodeDecodeError) as error:
            raise ConfigError(f"{path}: not a YAML file: {one_line(error)}") from error
        return cls.from_mapping(document, source=str(path))

    @classmethod
    def from_mapping(cls, document: Any, source: str = "configuration") -> Self:
        """Validate a mapping, as parsed from YAML. Raises ConfigError, whose message names `source`."""
        if not isinstance(document, Mapping):
            raise ConfigError(f"{source}: expected a mapping with keys such as 'league' and 'environment'")
        try:
            return cls.model_validate(document)
        except ValidationError as error:
            raise ConfigError(f"{source}: {_describe(cls, error)}") from error

    def with_training(self, **settings: Any) -> Self:
        """Return the configuration with some training settings replaced. Raises ConfigError if it is invalid."""
        training = self.training.model_dump(by_alias=True) | settings
        return self.from_mapping(self.model_dump(by_alias=True) | {"training": training}, source=self.league)


def _slug(kind: str, value: str) -> str:
    try:
        return check_slug(kind, value)
    except InvalidReference as error:
        raise ValueError(str(error)) from error


def _describe(model: type[BaseModel], error: ValidationError) -> str:
    """The first errors of a ValidationError as a sentence."""
    return "; ".join(_describe_one(model, detail) for detail in error.errors()[:3])


def _describe_one(model: type[BaseModel], detail: Any) -> str:
    path, known_by = [str(part) for part in detail["loc"]], model
    if path[:1] == ["training"] and len(path) > 1 and path[1] in ALGORITHMS:
        # Pydantic includes the member of the union in the path.
        known_by = ALGORITHMS[path.pop(1)]
        path = [part for part in path if part not in SCHEDULE_FORMS]
    key = ".".join(path) or "file"
    match detail["type"]:
        case "missing":
            return f"{key}: missing, but required"
        case "extra_forbidden" if path[-1] in RENAMED_KEYS:
            return f"{key}: this key has been renamed to {RENAMED_KEYS[path[-1]]!r}"
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
            continue  # the index of a list whose item model is already current
        fields = {field.alias or name: field for name, field in model.model_fields.items()}
        annotation = fields[part].annotation if part in fields else None
        while get_origin(annotation) is not None and get_args(annotation):
            annotation = get_args(annotation)[0]
        if not (isinstance(annotation, type) and issubclass(annotation, BaseModel)):
            return []
        model = annotation
    return [field.alias or name for name, field in model.model_fields.items()]
