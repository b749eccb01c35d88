"""`league sweep`."""

from typing import TYPE_CHECKING, Annotated

import typer

from policy_league.cli.interrupt import INTERRUPTED, exit_on_interrupt
from policy_league.cli.options import Config, open_registry
from policy_league.cli.output import console, say, table
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
    from training.sweeps.sweep import SweepReport


def sweep(
    config: Config,
    resume: Annotated[bool, typer.Option("--resume", help="Resume an interrupted sweep.")] = False,
    publish: Annotated[bool, typer.Option(help="Publish the last checkpoint of the best trial as a version.")] = True,
    samples: Annotated[
        int | None, typer.Option(min=1, help="Number of samples of the random parameters. Overrides CONFIG.")
    ] = None,
    address: Address = None,
    minutes: Minutes = None,
    steps: Steps = None,
    seed: Seed = None,
    runners: Runners = None,
    gpus: Gpus = None,
    cpus: Cpus = None,
    object_store: ObjectStore = None,
    dashboard: Dashboard = False,
) -> None:
    """Train with each combination of settings and report the best.

    Runs one trial per combination of the values in CONFIG's `sweep` section. Prints all trials, and the settings of the
    best one as YAML. TensorBoard logs are written to LEAGUE_HOME/sweeps. `league sweep CONFIG --resume` continues after
    an interruption.
    """
    from league.ray_cluster import LocalRay
    from training.sweeps.sweep import sweep as run

    league = load_config(config, without_none(minutes=minutes, steps=steps, seed=seed, runners=runners, gpus=gpus))
    if samples is not None and league.sweep is not None:
        league = league.model_copy(update={"sweep": league.sweep.model_copy(update={"samples": samples})})
    with exit_on_interrupt():
        report = run(
            league,
            registry=open_registry(),
            resume=resume,
            publish_best=publish,
            address=address,
            local=LocalRay(cpus, object_store, dashboard),
            config_path=find(config),
            console=console,
        )
    _show(report, config)
    if not report.is_whole:
        raise typer.Exit(INTERRUPTED)


def _show(report: "SweepReport", config: str) -> None:
    import yaml

    from training.sweeps.search_space import nested

    names = list(report.trials[0].settings)
    table(
        ("trial", *names, "score", "steps", "minutes", "note"),
        [
            (
                trial.number,
                *(str(trial.settings[name]) for name in names),
                trial.score,
                None if trial.outcome is None else trial.outcome.steps,
                None if trial.outcome is None else f"{trial.outcome.seconds / 60:.1f}",
                _note(trial.error, trial.outcome is None, trial.outcome is not None and trial.outcome.ended_early),
            )
            for trial in report.trials
        ],
        prose=("note",),
        optional=("note",),
    )
    say(f"\nPlot the metrics: tensorboard --logdir {report.path}")
    if not report.is_whole:
        say(f"Some trials are incomplete. To continue: league sweep {config} --resume")
    elif report.best is None:
        say("No trial has a score, as none completed an episode. Increase the number of steps.")
    else:
        say(f"Best trial: {report.best.number}. Settings:\n")
        say(yaml.safe_dump({"training": nested(report.best.settings)}, sort_keys=False, default_flow_style=None))
    if report.version is not None:
        say(f"Published as {report.version.ref}.")


def _note(error: Exception | None, is_open: bool, ended_early: bool) -> str:
    if error is not None:
        return str(error)
    return "incomplete" if is_open else "ended early" if ended_early else ""
