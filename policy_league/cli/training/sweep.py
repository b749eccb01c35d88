"""`league sweep`."""

from typing import TYPE_CHECKING, Annotated, Any

import typer

from league.interruption import exit_code
from policy_league.cli.interrupt import exit_on_interrupt
from policy_league.cli.options import Config, open_registry
from policy_league.cli.output import console, say, table
from policy_league.cli.training.options import TrainingOptions, with_training_options
from policy_league.configs.bundled import find

if TYPE_CHECKING:
    from training.sweeps.sweep import SweepReport, TrialReport


@with_training_options
def sweep(
    config: Config,
    *,
    options: TrainingOptions,
    resume: Annotated[bool, typer.Option("--resume", help="Resume an interrupted sweep.")] = False,
    publish: Annotated[bool, typer.Option(help="Publish the last checkpoint of the best trial as a version.")] = True,
    samples: Annotated[
        int | None,
        typer.Option(
            min=1, help="Number of samples of the random parameters; of trials, with Optuna. Overrides CONFIG."
        ),
    ] = None,
) -> None:
    """Train with each combination of settings and report the best.

    Runs one trial per combination of the values in CONFIG's `sweep` section, or those that Optuna chooses. Prints all
    trials, and the settings of the best one as YAML. TensorBoard logs are written to LEAGUE_HOME/sweeps. `league sweep
    CONFIG --resume` continues after an interruption.
    """
    league = options.league(config)
    if samples is not None and league.sweep is not None:
        league = league.model_copy(update={"sweep": league.sweep.model_copy(update={"samples": samples})})
    registry = open_registry()
    with exit_on_interrupt(), options.connected(registry.storage):
        from evaluation.service.strength_process import StrengthProcess
        from training.sweeps.sweep import sweep as run

        report = run(
            league,
            registry=registry,
            resume=resume,
            publish_best=publish,
            config_path=find(config),
            console=console,
            open_games=StrengthProcess,
        )
    _show(report, config)
    if not report.is_whole:
        raise typer.Exit(exit_code())


def _show(report: "SweepReport", config: str) -> None:
    import yaml

    from training.sweeps.search_space import nested

    names = list(report.trials[0].settings)
    columns = ("trial", *names, "score", "95 % interval", "steps", "minutes", "note")
    table(columns, [_row(trial, names) for trial in report.trials], prose=("note",), optional=("95 % interval", "note"))
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


def _row(trial: "TrialReport", names: list[str]) -> tuple[Any, ...]:
    from training.sweeps.search_space import format_value

    settings = [format_value(trial.settings[name]) for name in names]
    note = "" if trial.error is None else str(trial.error)
    if (outcome := trial.outcome) is None:
        return (trial.number, *settings, None, None, None, None, note or "incomplete")
    interval = None if outcome.low is None else f"{outcome.low:.3f} to {outcome.high:.3f}"
    note = note or ("ended early" if outcome.ended_early else "")
    return (trial.number, *settings, trial.score, interval, outcome.steps, f"{outcome.seconds / 60:.1f}", note)
