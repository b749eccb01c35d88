"""Options that `league train` and `league sweep` share."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields
from functools import wraps
from inspect import Parameter, signature
from typing import TYPE_CHECKING, Annotated, Any

import typer

from policy_league.cli.output import say
from policy_league.configs.bundled import find

if TYPE_CHECKING:
    from league.config.league import LeagueConfig
    from league.ray_cluster import LocalRay
    from league.settings import Storage

PRELOADED = "training.runs.preloaded"


@dataclass(frozen=True, slots=True)
class TrainingOptions:
    """Where to train, and settings that override those of CONFIG."""

    address: Annotated[
        str | None, typer.Option(help="Running Ray cluster (`auto`, or HOST:PORT). Default: start Ray on this machine.")
    ] = None
    minutes: Annotated[float | None, typer.Option(help="Maximum training time. Overrides CONFIG.")] = None
    steps: Annotated[int | None, typer.Option(help="Maximum number of actions of all agents. Overrides CONFIG.")] = None
    seed: Annotated[int | None, typer.Option(help="Random seed. Overrides CONFIG.")] = None
    runners: Annotated[int | None, typer.Option(min=0, help="Number of sampling processes. Overrides CONFIG.")] = None
    gpus: Annotated[float | None, typer.Option(min=0, help="Number of GPUs for the learner. Overrides CONFIG.")] = None
    cpus: Annotated[int | None, typer.Option(min=1, help="Number of CPUs for the local Ray. Default: all.")] = None
    object_store: Annotated[
        int | None, typer.Option(metavar="MB", help="Size of the local Ray's object store. Default: Ray's own.")
    ] = None
    dashboard: Annotated[
        bool, typer.Option("--dashboard", help="Start the local Ray's dashboard and print its URL.")
    ] = False

    @property
    def settings(self) -> dict[str, object]:
        """The settings of `training` that are given."""
        return without_none(
            minutes=self.minutes, steps=self.steps, seed=self.seed, runners=self.runners, gpus=self.gpus
        )

    def league(self, config: str) -> "LeagueConfig":
        """Load a configuration with these settings."""
        from league.config.league import LeagueConfig

        return LeagueConfig.load(find(config)).with_training(**self.settings)

    @property
    def local(self) -> "LocalRay":
        """The limits of a Ray that is started."""
        from league.ray_cluster import LocalRay

        return LocalRay(self.cpus, self.object_store, self.dashboard, preload=PRELOADED)

    @contextmanager
    def connected(self, storage: "Storage") -> Iterator[None]:
        """Connect to Ray, before this process imports PyTorch: the workers of a local Ray do so at the same time."""
        from league.ray_cluster import connected

        with connected(self.address, storage, self.local) as dashboard:
            if dashboard is not None:
                say(f"Ray's dashboard: {dashboard}")
            yield


def with_training_options(command: Callable[..., None]) -> Callable[..., None]:
    """Replace the parameter `options` of a command by the fields of TrainingOptions, which Typer makes options of."""
    shared = [
        Parameter(field.name, Parameter.KEYWORD_ONLY, default=field.default, annotation=field.type)
        for field in fields(TrainingOptions)
    ]

    @wraps(command)
    def parse(**arguments: Any) -> None:
        options = TrainingOptions(**{option.name: arguments.pop(option.name) for option in shared})
        command(**arguments, options=options)

    declared = signature(command)
    other_parameters = [
        parameter.replace(kind=Parameter.KEYWORD_ONLY)
        for parameter in declared.parameters.values()
        if parameter.name != "options"
    ]
    parse.__signature__ = declared.replace(parameters=[*other_parameters, *shared])  # type: ignore[attr-defined]
    return parse


def without_none(**options: object) -> dict[str, object]:
    """Return the options that are given."""
    return {name: value for name, value in options.items() if value is not None}
