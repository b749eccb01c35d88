"""`league train`."""

import os
import shlex
from contextlib import closing
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from league.errors import ConfigError
from league.refs import CheckpointRef, of_league
from policy_league.cli.interrupt import exit_on_interrupt
from policy_league.cli.options import Config, open_registry
from policy_league.cli.output import console, say
from policy_league.cli.training.options import TrainingOptions, with_training_options, without_none
from policy_league.configs.bundled import find

if TYPE_CHECKING:
    from league.config.league import LeagueConfig
    from league.registry.registry import Registry
    from league.registry.storage.rows import VersionRow

TOKENS = {"RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH"}


@with_training_options
def train(
    config: Config,
    *,
    options: TrainingOptions,
    parent: Annotated[
        str | None,
        typer.Option("--from", metavar="REF", help="Continue from this version, such as connect_four@3 or @champion."),
    ] = None,
    role: Annotated[
        Literal["main", "exploiter"], typer.Option("--role", help="`exploiter`: a run against one version only.")
    ] = "main",
    against: Annotated[
        str | None,
        typer.Option(
            metavar="REF", help="The opponent of an exploiter in all episodes, such as connect_four@champion."
        ),
    ] = None,
    like: Annotated[
        str | None,
        typer.Option(metavar="REF", help="Use as many runners, environments, threads and GPUs as this version's run."),
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Resume an interrupted run, or a completed one with a larger budget.")
    ] = False,
    job: Annotated[
        bool, typer.Option("--job", help="Submit a Ray job. --address is the cluster's dashboard, http://HOST:8265.")
    ] = False,
) -> None:
    """Train a league's policies and publish versions.

    A version is published at each checkpoint. It contains one ONNX graph per policy, tested for the same actions as the
    trained network. TensorBoard logs are written to LEAGUE_HOME/runs. Ctrl-C publishes the current state and exits;
    `league train CONFIG --resume` continues after an interruption.

    With --role exploiter, the version named by --against is the opponent in all episodes, the settings of
    training.exploiter apply, and the published versions cannot become champion. `--resume --role exploiter` continues
    the newest exploiter's run.

    The cores and GPUs determine how many runners, environments and threads a run uses, unless CONFIG does. All of them
    affect what is learned: --like repeats a run on another machine.

    A job continues when this command exits. Custom environments must be installed on the cluster.

    Next step: `league nightly CONFIG` finds the strongest version and promotes it.
    """
    league = options.league(config)
    if job:
        run_options = without_none(
            **{"from": parent, "role": None if role == "main" else role}, against=against, like=like
        )
        _submit(find(config), run_options, resume, options)
        return
    registry = open_registry()
    with exit_on_interrupt(), options.connected(registry.storage):
        from evaluation.service.strength_process import StrengthProcess
        from training.runs.train import train as run

        if like is not None:
            league = league.with_training(**_resources_of(registry, like, league) | options.settings)
        with closing(StrengthProcess(registry.storage)) as measure:
            published = run(
                league,
                registry=registry,
                parent=_version(parent, league),
                role=role,
                target=_version(against, league),
                resume=resume,
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


def _submit(config: Path, run_options: dict[str, object], resume: bool, options: TrainingOptions) -> None:
    # Let Ray send the user's token to the dashboard. Ray 2.60 reads this setting when it is imported.
    if os.environ.keys() & TOKENS or Path("~/.ray/auth_token").expanduser().exists():
        os.environ.setdefault("RAY_AUTH_MODE", "token")
    from league.ray_cluster import check_unlimited
    from league.settings import Storage
    from training.runs.job_submission import submit

    if options.address is None:
        raise ConfigError("--job requires --address http://HOST:8265, the URL of the cluster's dashboard")
    check_unlimited(options.local)
    arguments = [f"--{name}={value}" for name, value in (run_options | options.settings).items()]
    with exit_on_interrupt():
        submit(options.address, config, arguments + ["--resume"] * resume, Storage.from_environment(), say)


def _resources_of(registry: "Registry", ref: str, league: "LeagueConfig") -> dict[str, object]:
    """Return the settings of a version's training that depend on the machine."""
    from training.algorithms.resources import Resources

    version = registry.versions.resolve(CheckpointRef.parse(of_league(ref, league.league)))
    settings = version.manifest.settings
    if not (recorded := {field.name: settings[field.name] for field in fields(Resources) if field.name in settings}):
        raise ConfigError(f"--like: {version.ref} was not trained by `league train`")
    return recorded


def _version(ref: str | None, league: "LeagueConfig") -> CheckpointRef | None:
    return None if ref is None else CheckpointRef.parse(of_league(ref, league.league))
