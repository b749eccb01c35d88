"""The configuration file of a league. Errors name the file, the key and the expected value."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Self

import yaml
from pydantic import ValidationError, field_validator, model_validator

from league.config.algorithms import IMPORTED, TrainingConfig
from league.config.base import JSON, Part
from league.config.environment import IN_PYTHON, EnvironmentConfig
from league.config.gate import GateConfig
from league.config.play import PlayConfig
from league.config.ppo import PPOConfig
from league.config.sweep import SweepConfig
from league.config.training import NightlyConfig, TrainingSettings
from league.config.validation_errors import describe_validation_error, describe_yaml_error
from league.entry_points import search_in
from league.environment_code import environment_code
from league.errors import ConfigError
from league.interface import digest
from league.refs import check_slug


class UniqueKeyLoader(yaml.SafeLoader):
    """Loads YAML without a key that occurs twice in a mapping, of which PyYAML would keep the last."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Return the mapping. Raises ConstructorError for a repeated key."""
        earlier_keys = set[tuple[str, str]]()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and (key.tag, key.value) in earlier_keys:
                raise yaml.constructor.ConstructorError(
                    problem=f"the key {key.value!r} occurs twice", problem_mark=key.start_mark
                )
            earlier_keys.add((key.tag, str(key.value)))
        return super().construct_mapping(node, deep)


class LeagueConfig(Part):
    """Configuration of a league. Only `league` and `environment` are required."""

    league: str
    """Name of the league: a-z, 0-9, `_` and `-`."""
    environment: EnvironmentConfig
    folder: str | None = None
    """Folder in which entry points are searched first, relative to the file; by default the folder of the file."""
    policies: dict[str, tuple[str, ...]] | str | None = None
    """Policy id → agents, by name, else by the first pattern (`player_*`) that matches. Alternatively a function
    `package.module:function` from agent to policy id. By default agents with equal spaces share a policy."""
    sides: dict[str, tuple[str, ...]] | None = None
    """Side → agents, by name or pattern. By default each agent is a separate side."""
    play: PlayConfig = PlayConfig()
    training: TrainingConfig = PPOConfig()
    gate: GateConfig = GateConfig()
    nightly: NightlyConfig = NightlyConfig()
    sweep: SweepConfig | None = None

    @field_validator("league")
    @classmethod
    def _league_is_slug(cls, value: str) -> str:
        return check_slug("league", value)

    @field_validator("policies", "sides")
    @classmethod
    def _keys_are_slugs(cls, value: dict[str, Any] | str | None) -> dict[str, Any] | str | None:
        if isinstance(value, str) and not all(part.strip() for part in value.partition(":")):
            raise ValueError("expected policy ids with their agents, or a function package.module:function")
        if isinstance(value, dict) and not value:
            raise ValueError("expected at least one entry")
        for key in value if isinstance(value, dict) else ():
            check_slug("name", key)
        return value

    @field_validator("training")
    @classmethod
    def _fits_the_algorithm(cls, value: TrainingConfig) -> TrainingConfig:
        """Return the settings as those of their algorithm, which those of exploiters fit, too."""
        training = typed(value)
        try:
            type(training).model_validate(settings := training.model_dump(by_alias=True) | training.exploiter)
        except ValidationError as error:
            raise ValueError(f"exploiter.{describe_validation_error(error, settings)}") from error
        return training

    @model_validator(mode="after")
    def _simulators_have_no_arguments(self) -> Self:
        if self.environment.external is not None:
            self.training.refuse(("curriculum", "wrappers"), f"training.{IN_PYTHON}")
            if (runners := self.training.runners) not in ("auto", 0, 1):
                raise ValueError(f"training.runners is {runners}: one process serves all simulators, expected 1")
        return self

    @model_validator(mode="after")
    def _search_in_folder(self) -> Self:
        if self.folder is not None:
            search_in(self.folder)
            self.environment.search_in(self.folder)
        return self

    @classmethod
    def load(cls, path: Path | str) -> Self:
        """Read a YAML file. Raises ConfigError if it cannot be read, or the configuration is invalid."""
        path = Path(path)
        try:
            document = yaml.load(path.read_text(encoding="utf-8"), UniqueKeyLoader)
        except OSError as error:
            raise ConfigError(f"{path}: {error.strerror or error}") from error
        except (yaml.YAMLError, ValueError, RecursionError) as error:
            raise ConfigError(f"{path}: {describe_yaml_error(error)}") from error
        # An invalid document is refused below.
        if isinstance(document, Mapping) and isinstance(configured_folder := document.get("folder"), str | None):
            folder = (path.parent / (configured_folder or "")).resolve()
            if not folder.is_dir():
                raise ConfigError(f"{path}: folder: {folder} is not a directory")
            document = {**document, "folder": str(folder)}
        return cls.from_mapping(document, source=str(path))

    @classmethod
    def from_mapping(cls, document: Any, source: str = "configuration") -> Self:
        """Validate a mapping, as parsed from YAML. Raises ConfigError, whose message names `source`."""
        if not isinstance(document, Mapping):
            raise ConfigError(f"{source}: expected a mapping with keys such as 'league' and 'environment'")
        if large := next(_large_integers(document), None):
            raise ConfigError(f"{source}: {large}, expected integers of at most 64 bits")
        try:
            return cls.model_validate(document)
        except ValidationError as error:
            raise ConfigError(f"{source}: {describe_validation_error(error, document)}") from error

    @property
    def training_openings(self) -> int:
        """Maximum number of random moves at the start of an episode of training."""
        training_plies = self.training.opening_plies
        return self.play.opening_plies if training_plies is None else training_plies

    def game(self) -> JSON:
        """Return what decides results: the environment's settings and code, and the rules of play, as flat JSON.

        Results of different games are never combined.
        """
        rules = {f"play.{name}": value for name, value in self.play.rules().items()}
        return {"environment": self.environment.digest(), **self.environment.code(), **rules}

    def game_digest(self) -> str:
        """Return the SHA-256 of `game`."""
        return digest(self.game())

    @property
    def training_environment(self) -> EnvironmentConfig:
        """The environment with the wrappers of training."""
        wrappers = (*self.environment.wrappers, *self.training.wrappers)
        return self.environment.model_copy(update={"wrappers": wrappers})

    def stage_environment(self, stage: int, seed: int = 0) -> EnvironmentConfig:
        """Return the environment of training in a stage of its curriculum, from 0; without one, there is one stage.

        seed: of the episode, from which random arguments are drawn.
        """
        environment, stages = self.training_environment, self.training.curriculum
        return environment.with_arguments(stages[stage].drawn(seed)) if stages else environment

    def training_code(self) -> dict[str, str]:
        """Return entry point → SHA-256 of its source files, of the user's code that `training` names."""
        return {name: environment_code(name, self.folder).source for name in self.training.entry_points}

    def with_training(self, **settings: Any) -> Self:
        """Return the configuration with some training settings replaced. Raises ConfigError if it is invalid."""
        training = self.training.model_dump(by_alias=True) | settings
        return self.from_mapping(self.model_dump(by_alias=True) | {"training": training}, source=self.league)

    def of_night(self, seed: int, share: float | None = None) -> Self:
        """Return the configuration of a run of `league nightly --train`.

        Args:
            seed: Seed of the run.
            share: Fraction of the budget for an exploiter, whose last checkpoint alone is published. None: a main run.
        """
        night, training = self.nightly, self.training
        limits = {"minutes": night.minutes or training.minutes, "steps": night.steps or training.steps}
        whole = training.model_copy(update=limits)
        if share is not None:
            return self.of_exploiter(seed, whole.max_steps, whole.minutes, share)
        settings: dict[str, Any] = {"seed": seed, "minutes": whole.minutes, "steps": whole.max_steps}
        if night.opponents is not None:
            settings["opponents"] = night.opponents.model_dump(by_alias=True)
        return self.with_training(**settings)

    def against(self, target: str) -> Self:
        """Return the configuration of a run of an exploiter, whose opponent in all episodes is `target`.

        It has the training settings that are different for exploiters. Raises ConfigError.
        """
        return self.with_training(**self.training.exploiter, exploiter={}, opponents=[{"ref": target, "share": 1.0}])

    def of_exploiter(self, seed: int, steps: int | None, minutes: float | None, share: float) -> Self:
        """Return the configuration of the run of an exploiter, whose last checkpoint alone is published.

        Args:
            seed: Seed of the run.
            steps: Actions of the run whose budget it shares; None for no limit.
            minutes: Minutes of that run; None for no limit.
            share: Fraction of that budget.
        """
        return self.with_training(
            seed=seed,
            minutes=None if minutes is None else minutes * share,
            steps=None if steps is None else max(1, round(steps * share)),
            checkpoint_every=None,
            checkpoint_minutes=None,
        )


def typed(settings: TrainingSettings) -> TrainingSettings:
    """Return the settings as those of their algorithm, if this process has imported it.

    Raises ValueError, which names the faults.
    """
    if (model := IMPORTED.get(settings.algorithm)) is None:
        return settings
    try:
        return model.model_validate(document := settings.model_dump(by_alias=True, exclude_unset=True))
    except ValidationError as error:
        raise ValueError(f"{describe_validation_error(error, document)} ({settings.algorithm})") from error


def _large_integers(value: Any, key: str = "") -> Iterator[str]:
    """The integers that neither a database nor JSON of other languages can hold, with their keys."""
    if isinstance(value, Mapping):
        for name, item in value.items():
            yield from _large_integers(item, f"{key}.{name}" if key else str(name))
    elif isinstance(value, list | tuple):
        for index, item in enumerate(value):
            yield from _large_integers(item, f"{key}.{index}")
    elif isinstance(value, int) and not -(2**63) <= value < 2**63:
        yield f"{key}: {str(value)[:32]}"
