"""Options that `league train` and `league sweep` share."""

from typing import TYPE_CHECKING, Annotated

import typer

from policy_league.configs.bundled import find

if TYPE_CHECKING:
    from league.config.league import LeagueConfig

Address = Annotated[
    str | None, typer.Option(help="Running Ray cluster (`auto`, or HOST:PORT). Default: start Ray on this machine.")
]
Cpus = Annotated[int | None, typer.Option(min=1, help="Number of CPUs for the local Ray. Default: all.")]
ObjectStore = Annotated[
    int | None, typer.Option(metavar="MB", help="Size of the local Ray's object store. Default: Ray's own.")
]
Dashboard = Annotated[bool, typer.Option("--dashboard", help="Start the local Ray's dashboard and print its URL.")]
Minutes = Annotated[float | None, typer.Option(help="Maximum training time. Overrides CONFIG.")]
Steps = Annotated[int | None, typer.Option(help="Maximum number of actions of all agents. Overrides CONFIG.")]
Seed = Annotated[int | None, typer.Option(help="Random seed. Overrides CONFIG.")]
Runners = Annotated[int | None, typer.Option(min=0, help="Number of sampling processes. Overrides CONFIG.")]
Gpus = Annotated[float | None, typer.Option(min=0, help="Number of GPUs for the learner. Overrides CONFIG.")]


def load_config(config: str, settings: dict[str, object]) -> "LeagueConfig":
    from league.config.league import LeagueConfig

    return LeagueConfig.load(find(config)).with_training(**settings)


def without_none(**options: object) -> dict[str, object]:
    return {name: value for name, value in options.items() if value is not None}
