"""`league compare`."""

from typing import TYPE_CHECKING, Annotated, Any

import typer

from policy_league.cli.options import AsJson, open_registry
from policy_league.cli.output import emit, say, table

if TYPE_CHECKING:
    from evaluation.reporting.run_comparison import RunComparison

RUN_HELP = "ID of a training run or its first characters; LEAGUE/RUN if several leagues have it."


def compare(
    run_a: Annotated[str, typer.Argument(metavar="RUN_A", help=RUN_HELP)],
    run_b: Annotated[str, typer.Argument(metavar="RUN_B", help=RUN_HELP)],
    as_json: AsJson = False,
) -> None:
    """Compare two training runs: settings, speed, curves and versions.

    Prints the settings that differ, the last values of the curves, and the score between the last versions if they have
    played each other. `league runs LEAGUE` lists the runs of a league.
    """
    from evaluation.reporting.run_comparison import compare_runs

    comparison = compare_runs(open_registry(), run_a, run_b)
    if as_json:
        emit(comparison.to_json())
    else:
        _show(comparison)


def _show(comparison: "RunComparison") -> None:
    runs = first, second = comparison.runs
    columns = ("", "first", "second")
    summary = {
        "run": [run.run for run in runs],
        "league": [run.league for run in runs],
        "algorithm": [run.algorithm for run in runs],
        "state": [run.state for run in runs],
        "from": [run.parent or "scratch" for run in runs],
        "began": [f"{run.began_at.astimezone():%Y-%m-%d %H:%M}" for run in runs],
        "actions": [f"{run.steps:,}" for run in runs],
        "minutes": [f"{run.seconds / 60:.1f}" for run in runs],
        "actions/s": [_number(run.actions_per_second) for run in runs],
        "versions": [", ".join(ref.partition("@")[2] for ref in run.versions) or "none" for run in runs],
    }
    table(columns, [(name, *values) for name, values in summary.items()], prose=columns[1:])
    if comparison.settings:
        say("\nSettings that differ:")
        table(columns, [(name, *map(_value, pair)) for name, pair in comparison.settings.items()], prose=columns[1:])
    if comparison.curves:
        say("\nLast values of the curves:")
        table(columns, [(name, *map(_number, pair)) for name, pair in comparison.curves.items()])
    if (between := comparison.between) is not None:
        low, high = between.interval
        say(
            f"\n{between.first} against {between.second}: score {between.score:.3f} [{low:.3f}, {high:.3f}] in"
            f" {between.games:,} games."
        )
    elif first.league == second.league and first.versions and second.versions:
        versions = f"{first.versions[-1]} {second.versions[-1]}"
        say(f"\nThe last versions have not played each other: league evaluate {first.league} {versions}")


def _value(value: Any) -> str:
    return "–" if value is None else str(value)


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:,.4g}" if abs(value) < 1000 else f"{value:,.0f}"
