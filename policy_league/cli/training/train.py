"""`league train`."""

import os
import shlex
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from league.errors import ConfigError
from league.refs import CheckpointRef, of_league
from policy_league.cli.interrupt import exit_on_interrupt
from policy_league.cli.options import Config, open_registry
from policy_league.cli.output import console, say
from policy_league.cli.training.options import (
    Address,
    Cpus,
    Dashboard,
    Gpus,
    Minutes,
    ObjectStore,
    Runners,
    Seed,
    Steps,
    load_config,
    without_none,
)
from policy_league.configs.bundled import find

if TYPE_CHECKING:
    from league.config.league import LeagueConfig
    from league.registry.storage.rows import VersionRow

TOKENS = {"RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH"}


Parent = Annotated[
    str | None,
    typer.Option("--from", metavar="REF", help="Continue from this version, such as connect_four@3 or @champion."),
]
Resume = Annotated[
    bool, typer.Option("--resume", help="Resume an interrupted run, or a completed one with a larger budget.")
]
Job = Annotated[
    bool, typer.Option("--job", help="Submit a Ray job. --address is the cluster's dashboard, http://HOST:8265.")
]


RoleName = Annotated[
    Literal["main", "exploiter"], typer.Option("--role", help="`exploiter`: a run against one version only.")
]
Against = Annotated[
    str | None,
    typer.Option(metavar="REF", help="The opponent of an exploiter in all episodes, such as connect_four@champion."),
]


def train(
    config: Config,
    parent: Parent = None,
    role: RoleName = "main",
    against: Against = None,
    resume: Resume = False,
    address: Address = None,
    job: Job = False,
    minutes: Minutes = None,
    steps: Steps = None,
    seed: Seed = None,
    runners: Runners = None,
    gpus: Gpus = None,
    cpus: Cpus = None,
    object_store: ObjectStore = None,
    dashboard: Dashboard = False,
) -> None:
    """Train a league's policies and publish versions.

    A version is published at each checkpoint. It contains one ONNX graph per policy, tested for the same actions as the
    trained network. TensorBoard logs are written to LEAGUE_HOME/runs. Ctrl-C publishes the current state and exits;
    `league train CONFIG --resume` continues after an interruption.

    With --role exploiter, the version named by --against is the opponent in all episodes, the settings of
    training.exploiter apply, and the published versions cannot become champion. `--resume --role exploiter` continues
    the newest exploiter's run.

    A job continues when this command exits. Custom environments must be installed on the cluster.

    Next step: `league nightly CONFIG` finds the strongest version and promotes it.
    """
    settings = without_none(minutes=minutes, steps=steps, seed=seed, runners=runners, gpus=gpus)
    league = load_config(config, settings)
    if job:
        options = without_none(
            **{"from": parent, "role": None if role == "main" else role}, against=against, **settings
        )
        _submit(address, find(config), options, resume, (cpus, object_store, dashboard))
        return
    from evaluation.service.strength_process import StrengthProcess
    from league.ray_cluster import LocalRay
    from training.runs.train import train as run

    registry = open_registry()
    with exit_on_interrupt(), closing(StrengthProcess(registry.storage)) as measure:
        published = run(
            league,
            registry=registry,
            parent=_version(parent, league),
            role=role,
            target=_version(against, league),
            resume=resume,
            address=address,
            local=LocalRay(cpus, object_store, dashboard),
            config_path=find(config),
            console=console,
            measure=measure,
        )
    if published:
        say(f"\nPublished {', '.join(version.ref for version in published)}.")
        say(f"Next: {next_step(config, published[-1])}")
    else:
        say("No version was published: the run ended before its first checkpoint.")


def next_step(config: str, version: "VersionRow") -> str:
    """The command that usually follows a run, whose newest version is `version`."""
    if version.exploits is None:
        return f"league nightly {shlex.quote(config)}   (find the strongest version)"
    return f"league exploitability {version.exploits}   (play its exploiters against it)"


def _show_token() -> None:
    """Let Ray send the user's token to the dashboard. Ray 2.60 reads this setting when it is imported."""
    if os.environ.keys() & TOKENS or Path("~/.ray/auth_token").expanduser().exists():
        os.environ.setdefault("RAY_AUTH_MODE", "token")


def _submit(
    address: str | None,
    config: Path,
    options: dict[str, object],
    resume: bool,
    local: tuple[int | None, int | None, bool],
) -> None:
    _show_token()
    from league.ray_cluster import LocalRay, check_unlimited
    from league.settings import Storage
    from training.runs.job_submission import submit

    if address is None:
        raise ConfigError("--job requires --address http://HOST:8265, the URL of the cluster's dashboard")
    check_unlimited(LocalRay(*local))
    arguments = [f"--{name}={value}" for name, value in options.items()] + ["--resume"] * resume
    with exit_on_interrupt():
        submit(address, config, arguments, Storage.from_environment(), say)


def _version(ref: str | None, league: "LeagueConfig") -> CheckpointRef | None:
    return None if ref is None else CheckpointRef.parse(of_league(ref, league.league))
